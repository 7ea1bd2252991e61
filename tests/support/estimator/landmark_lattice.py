"""Landmarks on surfaces: where they are, which ones a place sees, where they appear."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.core import BoxGrid
from fleetmap.geometry import Array
from support.estimator.hashing import Words, mixed, uniform

_SMALLEST_COSINE = 0.15  # surfaces seen more obliquely show no corner twice
_OWN_SURFACE_M = 0.03
_MATERIAL_FLOOR, _MATERIAL_LAMP = 1, 2


class Viewpoint(NamedTuple):
    """A camera: cam_from_map (3, 3) is its rotation, centre (3,) its place in map.

    It sees the cone |x/z|, |y/z| < widest (2,), and a landmark of 1 m from reach_per_m metres down to that by
    octave_span.
    """

    cam_from_map: Array
    centre: Array
    reach_per_m: float
    widest: Array
    octave_span: float


def seed_landmarks(
    quads: Array, values: Array, numbers: NDArray[np.int32], weights: Array, cell_m: float
) -> tuple[Array, Array, Array, Words]:
    """Landmarks on faces: points, normals (N, 3) in map; sizes_m (N,); keys (N, 3): look, dirt, id.

    One per cell of a lattice on the surface, where the texture is rich enough: weights (T,) are the shares of cells.
    What a cell holds follows from texture and cell alone, so equal textures look alike; dirt follows from the face.
    """
    rich = (weights[numbers[:, 1]] > 0.0) & (numbers[:, 0] != _MATERIAL_LAMP)
    quads, values, numbers = quads[rich], values[rich], numbers[rich]
    lengths_m = [_length(quads[:, 3:6]), _length(quads[:, 6:9])]
    columns, rows = (np.ceil(length_m / cell_m).astype(np.int64) for length_m in lengths_m)
    cells = columns * rows
    face = np.repeat(np.arange(len(quads)), cells)
    number = np.arange(len(face)) - np.repeat(np.cumsum(cells) - cells, cells)
    j, i = np.divmod(number, columns[face])
    offsets = values[:, 3:5].astype(np.uint64)
    dirt = mixed(offsets[:, 0] * np.uint64(1024) + offsets[:, 1], 7)[face]
    look = mixed(numbers[face, 1].astype(np.uint64), j * 65536 + i)
    # Concrete does not repeat from face to face.
    look = np.where(numbers[face, 0] == _MATERIAL_FLOOR, mixed(look, dirt), look)
    first = mixed(look, 1)
    u = (i + uniform(first)) * cell_m / lengths_m[0][face]
    v = (j + uniform(mixed(first, look))) * cell_m / lengths_m[1][face]
    kept = np.flatnonzero((u < 1.0) & (v < 1.0) & (uniform(mixed(look, 3)) < weights[numbers[face, 1]]))
    face, u, v, look, dirt = face[kept], u[kept], v[kept], look[kept], dirt[kept]
    points = quads[face, :3] + u[:, None] * quads[face, 3:6] + v[:, None] * quads[face, 6:9]
    (ux, uy, uz), (vx, vy, vz) = quads[:, 3:6].T, quads[:, 6:9].T
    outward = np.stack([vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux], axis=1)
    normals = (outward * (1.0 / _length(outward))[:, None])[face]
    sizes_m = cell_m * (0.7 + 0.7 * uniform(mixed(look, 2)))
    place, *others = ((points * 1000.0).astype(np.int64) + 1048576).astype(np.uint64).T
    for other in others:
        place = mixed(place, other)
    return points, normals, sizes_m, np.stack([look, dirt, mixed(place, look) >> np.uint64(2)], axis=1)


def visible_from(
    first: int, points: Array, normals: Array, sizes_m: Array, view: Viewpoint, grid: BoxGrid
) -> NDArray[np.int64]:
    """Rows of landmarks from `first` on that a camera may see: in its cone, facing it, of a size that its octaves cover, behind no box."""
    cam_from_map, centre, reach_per_m, widest, octave_span = view
    off, reaches = points[first:] - centre, sizes_m[first:] * reach_per_m
    squared = _squared(off)
    near = np.flatnonzero((squared <= reaches**2) & (squared * octave_span * octave_span >= reaches**2))
    off, squared, normals = off[near], squared[near], normals[first:][near]
    x, y, z = (_dot(off, row) for row in cam_from_map)
    distances = np.sqrt(squared)
    seen = (z >= 0.2) & (np.abs(x) <= widest[0] * z) & (np.abs(y) <= widest[1] * z)
    seen &= _dot(off, normals.T) <= -_SMALLEST_COSINE * distances
    off, distances = off[seen], distances[seen]
    hits = grid.cast(centre, off / distances[:, None], distances - _OWN_SURFACE_M)[1]
    return first + near[seen][hits[:, 0] < 0]


def project(
    points: Array, sizes_m: Array, rect_from_map: Array, pinhole: Array, reach_per_m: float
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Rows of points inside the left picture, their pixels (N, 3) u_left v u_right, octaves, distances.

    rect_from_map (2, 3, 4): left and right; pinhole (5,): focal cx cy width height. The right camera's own axes give
    u_right.
    """
    (x, y, z), (x_right, _, z_right) = (
        [_dot(points, row) + row[3] for row in view_from_map] for view_from_map in rect_from_map
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = pinhole[0] * x / z + pinhole[1], pinhole[0] * y / z + pinhole[2]
        u_right = pinhole[0] * x_right / z_right + pinhole[1]
    inside = (z >= 0.2) & (u >= 0.0) & (v >= 0.0) & (u <= pinhole[3] - 1) & (v <= pinhole[4] - 1)
    rows = np.flatnonzero(inside)
    distances = np.sqrt(_squared(np.stack([x, y, z], axis=1)[rows]))
    # numpy's own logarithm is another on each processor.
    octaves = np.array([math.log(share) for share in (sizes_m[rows] * reach_per_m / distances).tolist()])
    octaves = octaves.reshape(-1) * (1.0 / math.log(1.2))
    kept = (octaves >= -0.5) & (octaves <= 7.5)
    rows = rows[kept]
    return rows, np.stack([u, v, u_right], axis=1)[rows], octaves[kept], distances[kept]


def _dot(points: Array, other: Array) -> Array:
    """(N,) of points (N, 3) with one vector or (3, N), from left to right."""
    return np.asarray(points[:, 0] * other[0] + points[:, 1] * other[1] + points[:, 2] * other[2])


def _squared(points: Array) -> Array:
    return _dot(points, points.T)


def _length(points: Array) -> Array:
    return np.sqrt(_squared(points))
