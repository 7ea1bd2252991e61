"""Search for aliases: places of a map that look the same as a recognized place. Pure.

Bags of words do not find them: a map within a budget holds different landmarks of every aisle, and single objects recur in
all aisles. The arrangement of objects does. Every landmark of the map that looks like a recognized one votes for
a camera that would see it so. Halls are assumed to be built at right angles; an alias rotated by any other angle is found by
its bag of words or not at all.

Source: the generalised Hough transform, Ballard 1981.
"""

from collections.abc import Generator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.matching import packed
from fleetmap.geometry import Array, Indices

_MAX_FEATURES, _MAX_PAIRS = 96, 400_000
_CELL_M = 0.5
_OWN_M = 1.2  # around the place itself
_OWN_LANDMARK_M = 0.5  # around recognized landmarks: themselves, and duplicates in the map
_COMPARISONS_PER_SLICE = 3_000_000  # about ten milliseconds
_MIN_VOTES = 6
_BORDER_M = 12.0  # around the map's landmarks, where cameras may stand
_REACH_M = 500.0  # limit of the search: memory must not grow with the distance of a single landmark
_QUARTER_TURNS = [np.array([[c, -s], [s, c]]) for c, s in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))]


class LandmarkSet(NamedTuple):
    """Landmarks: points_map (N, 3) and descriptors (N, 32)."""

    points_map: Array
    descriptors: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class AliasCandidate:
    """A camera pose with the same view: map_from_cam (4, 4), accurate to about a cell.

    alias_ratio: its votes as a share of those for the recognized place. features (P,) with landmarks (P,), rows of the map: pairs that
    voted for it.
    """

    map_from_cam: Array
    alias_ratio: float
    features: Indices
    landmarks: Indices


def find_aliases(
    seen: LandmarkSet, landmarks: LandmarkSet, map_from_cam: Array, min_ratio: float, max_count: int
) -> Generator[None, None, list[AliasCandidate]]:
    """Find aliases of a camera's place in the map of `landmarks`, best first, with at least a share of its own votes; in slices.

    seen: descriptors of the landmarks recognized there, and their points in the map.
    """
    used = np.linspace(0, len(seen.points_map) - 1, min(len(seen.points_map), _MAX_FEATURES)).astype(np.int64)
    points_map = seen.points_map[used]
    features, others = packed(seen.descriptors[used]), packed(landmarks.descriptors)
    heights_m = np.ascontiguousarray(points_map[:, 2])
    found, room = [np.zeros((0, 2), np.int32)], _MAX_PAIRS
    step = max(1, _COMPARISONS_PER_SLICE // max(len(used), 1))
    for first in range(0, len(others), step):
        if first:
            yield
        last = min(first + step, len(others))
        found.append(core.lookalikes(features, heights_m, others, landmarks.points_map, first, last, room))
        room -= len(found[-1])
    pairs = np.concatenate(found)
    pairs = np.ascontiguousarray(pairs[np.argsort(pairs[:, 0], kind="stable")])
    votes = _Votes(pairs, points_map, landmarks.points_map, map_from_cam)
    return [votes.candidate(*peak, used) for peak in votes.peaks(min_ratio, max_count)]


class _Votes:
    """Votes of pairs (P, 2), features at points_map (F, 3) with landmarks (N, 3) that look like them, for cells of (x, y, quarter turn)."""

    def __init__(self, pairs: NDArray[np.int32], points_map: Array, landmarks_map: Array, map_from_cam: Array) -> None:
        self._map_from_cam, self._landmarks_map = map_from_cam, landmarks_map
        here = map_from_cam[:2, 3]
        self._low = np.maximum(landmarks_map[:, :2].min(axis=0) - _BORDER_M, here - _REACH_M)
        high = np.maximum(
            np.minimum(landmarks_map[:, :2].max(axis=0) + _BORDER_M, here + _REACH_M), self._low + 2 * _CELL_M
        )
        self._shape: tuple[int, int] = tuple(np.ceil((high - self._low) / _CELL_M).astype(int).tolist())
        offsets = points_map[:, :2] - map_from_cam[:2, 3]
        self._offsets = [np.ascontiguousarray(offsets @ turn.T) for turn in _QUARTER_TURNS]
        # Landmarks of the place itself vote for it alone. Near a camera they lie in the same cell, seen from any side.
        away_m = np.linalg.norm(landmarks_map[pairs[:, 1]] - points_map[pairs[:, 0]], axis=1)
        self._others = np.ascontiguousarray(pairs[away_m > _OWN_LANDMARK_M])
        self._counts = np.stack([self._cast(self._others, quarter) for quarter in range(4)])
        there = self._cast(pairs, 0)
        column, row = np.clip(((map_from_cam[:2, 3] - self._low) / _CELL_M).astype(int), 1, np.array(self._shape) - 1)
        self._own = max(int(there[column - 1 : column + 1, row - 1 : row + 1].max()), 1)

    def _cast(self, pairs: NDArray[np.int32], quarter: int) -> NDArray[np.int32]:
        return core.camera_votes(pairs, self._offsets[quarter], self._landmarks_map, self._low, _CELL_M, *self._shape)

    def peaks(self, min_ratio: float, max_count: int) -> list[tuple[int, Array, float]]:
        """Quarter turn, (x, y) and relative votes of the best cells, excluding cells near a better one or near the place itself."""
        quarters, columns, rows = np.nonzero(self._counts >= _MIN_VOTES)
        centres = self._low + _CELL_M * (np.column_stack([columns, rows]) + 1.0)
        votes = self._counts[quarters, columns, rows]
        is_own = (quarters == 0) & (np.linalg.norm(centres - self._map_from_cam[:2, 3], axis=1) < _OWN_M)
        order = np.flatnonzero(~is_own & (votes >= min_ratio * self._own))
        found: list[tuple[int, Array, float]] = []
        for k in order[np.argsort(-votes[order], kind="stable")].tolist():
            quarter, centre = int(quarters[k]), centres[k]
            if any(quarter == q and np.linalg.norm(centre - other) < _OWN_M for q, other, _ in found):
                continue
            found.append((quarter, centre, float(votes[k] / self._own)))
            if len(found) == max_count:
                break
        return found

    def candidate(self, quarter: int, centre: Array, ratio: float, used: Indices) -> AliasCandidate:
        """The camera at a peak, in the median of its votes; used (F,): numbers of the features among all recognized ones."""
        pairs = self._others
        cameras = self._landmarks_map[pairs[:, 1], :2] - self._offsets[quarter][pairs[:, 0]]
        voted = (np.abs(cameras - centre) < _CELL_M).all(axis=1)
        place = self._map_from_cam.copy()
        place[:2, 3] = np.median(cameras[voted], axis=0)
        place[:2, :3] = _QUARTER_TURNS[quarter] @ self._map_from_cam[:2, :3]
        return AliasCandidate(place, ratio, used[pairs[voted, 0]], pairs[voted, 1].astype(np.int64))
