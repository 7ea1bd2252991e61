"""Places of a map that look the same as one that was found. Pure.

Words do not tell them: a map within a budget holds other landmarks of every aisle, and what stands in one aisle stands in part in
all others. What does: the same things in the same order. Each thing that was recognized is looked for in the whole map, and every
landmark that looks like it speaks for a camera that would see it so. Halls are taken to be built at right angles; a twin that is
turned by anything else is found by its words or not at all.
"""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching import packed
from fleetmap.geometry import Array
from fleetmap.relocalization import alias_search_kernels

_MOST_FEATURES, _MOST_PAIRS = 96, 400_000
_MAX_BITS, _HEIGHT_M = 50, 0.3
_CELL_M = 0.5
_OWN_M = 1.2  # around the place itself
_OWN_THING_M = 0.5  # around what was recognized: it, and what of it was mapped twice
_AT_ONCE = 3_000_000  # comparisons in a slice: some ten milliseconds
_LEAST_VOTES = 6


@dataclass(frozen=True, slots=True)
class AliasCandidate:
    """A camera that would see the same: map_from_cam (4, 4), about a cell exact; how many features speak for it, as a share of
    those that speak for the place that was found; and features (P,) with landmarks (P,), rows of the map, that do."""

    map_from_cam: Array
    share: float
    features: NDArray[np.int64]
    landmarks: NDArray[np.int64]


def find_aliases(
    descriptors: NDArray[np.uint8], points_map: Array, map_descriptors: NDArray[np.uint8], map_points_map: Array,
    map_from_cam: Array, least_share: float, most: int,
) -> Generator[None, None, list[AliasCandidate]]:  # fmt: skip
    """Twins of a camera's place, best first, for which at least a share of the votes of the place itself is given; in slices.

    descriptors (F, 32), points_map (F, 3): of what was recognized there, and where the map says that it is.
    """
    used = np.linspace(0, len(points_map) - 1, min(len(points_map), _MOST_FEATURES)).astype(np.int64)
    features, landmarks = packed(descriptors[used]), packed(map_descriptors)
    heights_m = np.ascontiguousarray(points_map[used, 2])
    pairs, count = np.empty((_MOST_PAIRS, 2), np.int32), 0
    step = max(1, _AT_ONCE // max(len(used), 1))
    for first in range(0, len(landmarks), step):
        if first:
            yield
        last = min(first + step, len(landmarks))
        count = alias_search_kernels.alike(
            features, heights_m, landmarks, map_points_map, first, last, _MAX_BITS, _HEIGHT_M, pairs, count
        )
    pairs = pairs[:count]
    pairs = np.ascontiguousarray(pairs[np.argsort(pairs[:, 0], kind="stable")])
    return _peaks(pairs, points_map[used], used, map_points_map, map_from_cam, least_share, most)


def _peaks(
    pairs: NDArray[np.int32], points_map: Array, used: NDArray[np.int64], map_points_map: Array, map_from_cam: Array,
    least_share: float, most: int,
) -> list[AliasCandidate]:  # fmt: skip
    place = map_from_cam[:2, 3]
    low, high = map_points_map[:, :2].min(axis=0) - 12.0, map_points_map[:, :2].max(axis=0) + 12.0
    shape = tuple(int(n) for n in np.ceil((high - low) / _CELL_M))
    # What stands at the place itself speaks for it alone. Near a camera it lies in the same cell from whichever side it is seen.
    other = np.linalg.norm(map_points_map[pairs[:, 1]] - points_map[pairs[:, 0]], axis=1) > _OWN_THING_M
    others = np.ascontiguousarray(pairs[other])
    counts = np.zeros((4, *shape), np.int32)
    turns = [np.array([[c, -s], [s, c]]) for c, s in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))]
    offsets = [(points_map[:, :2] - place) @ turn.T for turn in turns]
    for quarter, offset in enumerate(offsets):
        alias_search_kernels.vote(
            others, offset, map_points_map, low, _CELL_M, np.full(shape, -1, np.int32), counts[quarter]
        )
    there = np.zeros(shape, np.int32)
    alias_search_kernels.vote(pairs, offsets[0], map_points_map, low, _CELL_M, np.full(shape, -1, np.int32), there)
    quarters, columns, rows = np.nonzero(counts >= _LEAST_VOTES)
    centres = low + _CELL_M * (np.column_stack([columns, rows]) + 1.0)
    votes = counts[quarters, columns, rows]
    is_own = (quarters == 0) & (np.linalg.norm(centres - place, axis=1) < _OWN_M)
    column, row = np.clip(((place - low) / _CELL_M).astype(int), 1, np.array(shape) - 1)
    own = max(int(there[column - 1 : column + 1, row - 1 : row + 1].max()), 1)
    order = np.flatnonzero(~is_own & (votes >= least_share * own))
    order = order[np.argsort(-votes[order], kind="stable")]
    found: list[AliasCandidate] = []
    taken: list[tuple[int, Array]] = []
    for k in order.tolist():
        quarter, centre = int(quarters[k]), centres[k]
        if any(quarter == q and np.linalg.norm(centre - other) < _OWN_M for q, other in taken):
            continue
        taken.append((quarter, centre))
        found.append(
            _twin(others, offsets[quarter], turns[quarter], centre, votes[k] / own, used, map_points_map, map_from_cam)
        )
        if len(found) == most:
            break
    return found


def _twin(
    pairs: NDArray[np.int32], offsets_m: Array, turn: Array, centre: Array, share: float, used: NDArray[np.int64],
    map_points_map: Array, map_from_cam: Array,
) -> AliasCandidate:  # fmt: skip
    cameras = map_points_map[pairs[:, 1], :2] - offsets_m[pairs[:, 0]]
    speaks = (np.abs(cameras - centre) < _CELL_M).all(axis=1)
    twin = map_from_cam.copy()
    twin[:2, 3] = np.median(cameras[speaks], axis=0)
    twin[:2, :3] = turn @ map_from_cam[:2, :3]
    return AliasCandidate(twin, float(share), used[pairs[speaks, 0]], pairs[speaks, 1].astype(np.int64))
