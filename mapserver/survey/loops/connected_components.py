"""Connected components of a survey: keyframes connected by shared landmarks or by short bridges of odometry.

Only one component can be in a map: the pose of any other relative to it is unknown.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, Indices, Mask
from mapserver.survey.loops.keyframe_groups import KeyframeGroups
from mapserver.survey.loops.loops import Loops
from mapserver.survey.settings import MIN_SEEN
from mapserver.survey.state import OdometryPass, SurveyState

SigmaBetween = Callable[[int, int], float]
MIN_SHARED = 15  # landmarks; a loop needs as many matches
_MIN_KEYFRAMES = 2
_UNKNOWN_M = 1e3
_SURE_SIGMAS = 3.0
_LARGEST = "the largest part"
_APART = "its position relative to the largest part is uncertain; drive it again"
_BLIND = "too little was seen to connect it; drive it again, with light"


@dataclass(frozen=True, slots=True)
class Component:
    """Connected keyframes: seconds of the first and last after the survey's first keyframe, whether they are kept, and the reason."""

    start_s: float
    end_s: float
    keyframes: int
    kept: bool
    reason: str

    def remark(self) -> str:
        """The component as text."""
        return f"left out: {self.keyframes} keyframes from {self.start_s:.1f} to {self.end_s:.1f} s: {self.reason}"


@dataclass(frozen=True, slots=True)
class Components:
    """labels (K,): the component of each keyframe, -1 for stray ones, which belong to no component and are listed per run."""

    labels: Indices
    components: list[Component]
    stray: list[Component]

    @property
    def kept(self) -> Mask:
        """(K,) keyframes that stay in the map: those of the component with the most keyframes that are not blind."""
        return np.asarray(self.labels == next(n for n, component in enumerate(self.components) if component.kept))


def find_components(state: SurveyState, odometry_sigmas_m: SigmaBetween, join_sigma_m: float) -> Components:
    """Return the components of an adjusted survey, ordered by time; SurveyError if no keyframes are connected.

    Keyframes are connected if they share landmarks, or if odometry between two consecutive ones that are not blind is accurate
    to `join_sigma_m`. Blind ones in between are then connected too; other blind ones belong to the previous or
    next component while three sigmas of the odometry are within that limit.
    """
    groups = np.unique(find_groups(state, odometry_sigmas_m, join_sigma_m).labels(), return_inverse=True)[1]
    seeing = np.flatnonzero(_seeing(state))
    sizes, seeing_sizes = np.bincount(groups), np.bincount(groups[seeing])
    real = [g for g in dict.fromkeys(groups[seeing].tolist()) if sizes[g] >= _MIN_KEYFRAMES]
    if not real:
        raise SurveyError(
            f"none of {len(groups)} keyframes shares {MIN_SHARED} landmarks with another; check the recording with "
            "`mapserver doctor`: dark, blurred, or too few frames?"
        )
    largest = max(real, key=lambda g: int(seeing_sizes[g]))
    labels = np.full(len(groups), -1, np.int64)
    for number, group in enumerate(real):
        labels[groups == group] = number

    def component(members: Indices, kept: bool, reason: str) -> Component:
        start_s, end_s = (round(float(state.stamps_ns[k] - state.stamps_ns[0]) * 1e-9, 3) for k in members[[0, -1]])
        return Component(start_s, end_s, len(members), kept, reason)

    components = [
        component(np.flatnonzero(labels == n), group == largest, _LARGEST if group == largest else _APART)
        for n, group in enumerate(real)
    ]
    stray = np.flatnonzero(labels < 0)
    runs = np.split(stray, np.flatnonzero(np.diff(stray) > 1) + 1)
    return Components(labels, components, [component(run, False, _BLIND) for run in runs if len(run)])


def find_groups(state: SurveyState, sigmas_m: SigmaBetween, join_sigma_m: float) -> KeyframeGroups:
    """Return the same before loops are closed: there may be many groups, and none is chosen."""
    marks, seeing = state.landmarks, _seeing(state)
    ones, shape = np.ones(len(marks.obs_keyframe), np.int32), (len(seeing), len(marks.points_map))
    seen = scipy.sparse.csr_matrix((ones, (marks.obs_keyframe, marks.obs_landmark)), shape)
    shared = scipy.sparse.coo_matrix(seen @ seen.T)
    enough = (shared.data >= MIN_SHARED) & (shared.row < shared.col)
    pairs = zip(shared.row[enough].tolist(), shared.col[enough].tolist(), strict=True)
    return KeyframeGroups([*pairs, *bridges(seeing, sigmas_m, join_sigma_m)], len(seeing))


def _seeing(state: SurveyState) -> Mask:
    return np.bincount(state.landmarks.obs_keyframe, minlength=len(state.stamps_ns)) >= MIN_SEEN


def bridges(seeing: Mask, sigmas_m: SigmaBetween, join_sigma_m: float, first: int = 0) -> list[tuple[int, int]]:
    """Yield keyframes connected by odometry, from `first` on; seeing (K,): False for blind ones. See find_components."""
    seen = first + np.flatnonzero(seeing[first:])
    joins = [(int(a), int(b)) for a, b in pairwise(seen) if sigmas_m(int(a), int(b)) <= join_sigma_m]
    bridged = {a for a, _ in joins}
    for k in (first + np.flatnonzero(~seeing[first:])).tolist():
        at = int(np.searchsorted(seen, k))
        limit_m = join_sigma_m if at and int(seen[at - 1]) in bridged else join_sigma_m / _SURE_SIGMAS
        for near in (seen[at - 1] if at else None, seen[at] if at < len(seen) else None):
            if near is not None and sigmas_m(min(k, int(near)), max(k, int(near))) <= limit_m:
                joins.append((int(near), k))
                break
    return joins


def sigma_between(odometry: OdometryPass) -> SigmaBetween:
    """Return the standard deviation, in metres, of keyframe b relative to keyframe a by odometry: the growth of its variance."""
    return grown_sigma(odometry.keyframe_variances_m2)


def grown_sigma(variances_m2: Array) -> SigmaBetween:
    """Return the same of keyframes with these variances (K,) of the position, summed over the axes."""
    return lambda a, b: float(np.sqrt(max(variances_m2[b] - variances_m2[a], 0.0)))


def without_doubted(odometry: OdometryPass, doubted: Sequence[int]) -> OdometryPass:
    """Return odometry that knows nothing of the motion from doubted keyframes to the next ones."""
    if not doubted:
        return odometry
    after = np.array(odometry.keyframe_frames)[np.array(doubted, int)]
    steps = np.searchsorted(after, np.arange(len(odometry.covariances)), side="left")
    return replace(odometry, covariances=odometry.covariances + _UNKNOWN_M**2 * steps[:, None, None] * np.eye(6))


def only_kept(
    state: SurveyState, odometry: OdometryPass, loops: Loops, kept: Mask
) -> tuple[SurveyState, OdometryPass, Loops]:
    """Return the survey of the kept keyframes (K,) alone; the records of loops keep the old numbers."""
    if kept.all():
        return state, odometry, loops
    number = np.cumsum(kept) - 1
    edges = [replace(e, i=int(number[e.i]), j=int(number[e.j])) for e in loops.edges if kept[e.i] and kept[e.j]]
    keyframes = [k for k, keep in zip(odometry.keyframes, kept, strict=True) if keep]
    return state.of(kept), replace(odometry, keyframes=keyframes), replace(loops, edges=edges)


def between_kept(frames: int, keyframe_frames: Indices, kept: Mask) -> Mask:
    """Return (F,) frames whose neighbouring keyframes, previous and next, are both kept."""
    before, after = np.searchsorted(keyframe_frames, [np.arange(1, frames + 1), np.arange(frames)])
    return np.asarray(kept[np.maximum(before - 1, 0)] & kept[np.minimum(after, len(kept) - 1)])
