"""Inner loop of revisit thinning: keyframes whose tracks enough other visits see too."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.numerics.kernel import inner_kernel, kernel

Indices = NDArray[np.int64]
Octaves = NDArray[np.int8]


class TrackMembers(NamedTuple):
    """M members: track, keyframe and octave (M,) of each; starts (G + 1,) delimits each track's, by rising keyframe."""

    tracks: Indices
    starts: Indices
    keyframes: Indices
    octaves: Octaves


@inner_kernel
def _other_visits(
    member: int, first: int, end: int, keyframes: Indices, octaves: Octaves, gap: int, spare: NDArray[np.bool_]
) -> int:
    """How many visits besides its own see the track [first, end) of a member, whose scale is not finer than theirs."""
    visits, last = 0, -1
    for n in range(first, end):
        k = keyframes[n]
        if spare[k] or abs(k - keyframes[member]) <= gap or octaves[n] > octaves[member] + 1:
            continue
        if last < 0 or k - last > gap:
            visits += 1
        last = k
    return visits


@kernel
def mark_repeated(
    rows: Indices,
    row_starts: Indices,
    members: TrackMembers,
    limits: tuple[int, int, float, int],
    spare: NDArray[np.bool_],
) -> None:
    """Sets spare (K,), from the last keyframe to the second, where a share of its tracks and `least` of them have so many other visits.

    rows[row_starts[k] : row_starts[k + 1]] are keyframe k's members. limits: gap (members more than so many keyframes apart are of
    different visits), visits, share, least.
    """
    (tracks, starts, keyframes, octaves), (gap, visits, share, least) = members, limits
    for k in range(len(spare) - 1, 0, -1):
        repeated = 0
        for at in range(row_starts[k], row_starts[k + 1]):
            member = rows[at]
            track = tracks[member]
            others = _other_visits(member, starts[track], starts[track + 1], keyframes, octaves, gap, spare)
            repeated += others >= visits
        spare[k] = repeated >= least and repeated >= share * (row_starts[k + 1] - row_starts[k])
