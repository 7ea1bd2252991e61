"""People, forklifts and robots in a run without pictures: what their boxes hide, and the corners that lie on them."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetsim.scene.movers import MOVER_KINDS, Mover
from support.estimator.landmarks import Landmarks, joined

_CELL_M, _SMALLEST_COSINE = 0.08, 0.15
_CORNER_SHARE = 0.5  # of the cells of clothes and paint; an assumption
_SKIN_M = 0.003  # inside its own box a corner is not hidden by it
_FIRST_ID = np.uint64(1) << np.uint64(62)  # above those of things that stand


class MoverLandmarks:
    """The movers of a run, at any moment."""

    def __init__(self, movers: tuple[Mover, ...]) -> None:
        self._movers = movers

    def boxes(
        self, time_s: float, near_map: Array, within_m: float = 20.0
    ) -> list[tuple[int, int, Array, Array, Array]]:
        """Those of movers near a place (3,): number of the mover, of its part, centre and half sizes (3,), map_from_box rotation (3, 3)."""
        found = []
        for number, mover in enumerate(self._movers):
            x_m, y_m, yaw_rad = mover.place(time_s)
            if np.hypot(x_m - near_map[0], y_m - near_map[1]) > within_m:
                continue
            cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
            rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
            for part, (centre, half, _) in enumerate(MOVER_KINDS[mover.kind][0](time_s)):
                place = rotation @ np.array(centre, np.float64) + (x_m, y_m, 0.0)
                found.append((number, part, place, np.array(half, np.float64), rotation))
        return found

    def around(self, time_s: float, centre_map: Array, landmarks: Landmarks) -> Landmarks:
        """`landmarks` that no mover hides from `centre_map` (3,), and those on the movers that face it; by rising id."""
        boxes = self.boxes(time_s, centre_map)
        if not boxes:
            return landmarks
        marks = joined([landmarks, *(_on_box(*box, centre_map) for box in boxes)])
        seen = np.ones(len(marks), bool)
        away = marks.points_map - centre_map
        far = np.linalg.norm(away, axis=1)
        for _, _, centre, half, rotation in boxes:
            rows = np.flatnonzero(_may_be_behind(away, far, centre - centre_map, half))
            seen[rows] &= ~_is_behind(marks.points_map[rows], centre_map, centre, half - _SKIN_M, rotation)
        return marks.take(np.flatnonzero(seen))


def _may_be_behind(away: Array, far_m: Array, toward: Array, half: Array) -> NDArray[np.bool_]:
    """(N,) which points, `away` (N, 3) from the eye, lie within the cone of the ball around a box, `toward` (3,) from the eye."""
    distance_m, radius_m = float(np.linalg.norm(toward)), float(np.linalg.norm(half))
    if distance_m <= radius_m:
        return np.ones(len(away), bool)
    cosine = np.sqrt(1.0 - (radius_m / distance_m) ** 2)
    return np.asarray(away @ (toward / distance_m) >= (cosine - 1e-9) * far_m)


def _is_behind(points: Array, eye: Array, centre: Array, half: Array, rotation: Array) -> NDArray[np.bool_]:
    """(N,) whether the way from the eye to each point (N, 3) leads through a box. Source: slabs (Kay and Kajiya 1986)."""
    begin, ends = (eye - centre) @ rotation, (points - centre) @ rotation
    way = ends - begin
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    one, two = (-half - begin) / way, (half - begin) / way
    first = np.minimum(one, two).max(axis=1)
    last = np.maximum(one, two).min(axis=1)
    return (first < last) & (last > 0.0) & (first < 1.0) & bool((half > 0).all())


@lru_cache(maxsize=256)
def _corners(
    number: int, part: int, half: tuple[float, float, float]
) -> tuple[Array, Array, Array, NDArray[np.uint64]]:
    """Corners on five faces of a box, in its axes: points, normals (N, 3), sizes_m (N,), keys (N, 3). The same for each mover's life."""
    rng, points, normals = np.random.default_rng([31, number, part]), [], []
    for axis, side in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1)):
        across = [a for a in range(3) if a != axis]
        area_m2 = 4 * half[across[0]] * half[across[1]]
        count = int(_CORNER_SHARE * area_m2 / _CELL_M**2 + rng.random())
        face = rng.uniform(-1.0, 1.0, (count, 3)) * half
        face[:, axis] = side * half[axis]
        points.append(face)
        normals.append(np.tile(side * np.eye(3)[axis], (count, 1)))
    total = sum(len(face) for face in points)
    keys = rng.integers(0, 1 << 62, (total, 3), np.uint64)
    keys[:, 2] = _FIRST_ID + np.uint64((number * 64 + part) << 20) + np.arange(total, dtype=np.uint64)
    return np.concatenate(points), np.concatenate(normals), rng.uniform(0.7, 1.4, total) * _CELL_M, keys


def _on_box(number: int, part: int, centre: Array, half: Array, rotation: Array, eye: Array) -> Landmarks:
    """Its corners that face the eye."""
    points, normals, sizes, keys = _corners(number, part, tuple(half.tolist()))
    placed = Landmarks(points @ rotation.T + centre, normals @ rotation.T, sizes, keys, np.zeros(1, np.int64))
    away = eye - placed.points_map
    facing = np.einsum("ni,ni->n", away, placed.normals_map) > _SMALLEST_COSINE * np.linalg.norm(away, axis=1)
    return placed.take(np.flatnonzero(facing))
