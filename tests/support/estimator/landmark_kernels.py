"""Landmarks on surfaces: where they are, which ones a place sees, where they appear."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.numerics.kernel import inner_kernel, kernel
from fleetsim.render.ray_kernels import BoxGrid, cast_ray

Float = NDArray[np.float64]
Words = NDArray[np.uint64]
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_SMALLEST_COSINE = 0.15  # surfaces seen more obliquely show no corner twice
_OWN_SURFACE_M = 0.03


@inner_kernel
def mixed(state: np.uint64, value: np.uint64) -> np.uint64:
    """`state` with `value` mixed in. Source: splitmix64."""
    state = state + value + _GOLDEN
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@inner_kernel
def uniform(bits: np.uint64) -> float:
    """0 <= x < 1 of well mixed bits."""
    return float(bits >> np.uint64(11)) * (1.0 / 9007199254740992.0)


class Viewpoint(NamedTuple):
    """A camera: cam_from_map (3, 3) is its rotation, centre (3,) its place in map.

    It sees the cone |x/z|, |y/z| < widest (2,), and a landmark of 1 m from reach_per_m metres down to that by
    octave_span.
    """

    cam_from_map: Float
    centre: Float
    reach_per_m: float
    widest: Float
    octave_span: float


@kernel
def seed_landmarks(
    quads: Float, values: Float, numbers: NDArray[np.int32], weights: Float, cell_m: float
) -> tuple[Float, Float, Float, Words]:
    """Landmarks on faces: points, normals (N, 3) in map; sizes_m (N,); keys (N, 3): look, dirt, id.

    One per cell of a lattice on the surface, where the texture is rich enough: weights (T,) are the shares of cells.
    What a cell holds follows from texture and cell alone, so equal textures look alike; dirt follows from the face.
    """
    points, normals = np.empty((0, 3)), np.empty((0, 3))
    sizes_m, keys = np.empty(0), np.empty((0, 3), np.uint64)
    for sweep in range(2):  # count, then fill
        count = 0
        for f in range(quads.shape[0]):
            weight = weights[numbers[f, 1]]
            if weight <= 0.0 or numbers[f, 0] == 2:
                continue
            ux, uy, uz, vx, vy, vz = quads[f, 3], quads[f, 4], quads[f, 5], quads[f, 6], quads[f, 7], quads[f, 8]
            length_u, length_v = math.sqrt(ux * ux + uy * uy + uz * uz), math.sqrt(vx * vx + vy * vy + vz * vz)
            dirt = mixed(np.uint64(values[f, 3]) * np.uint64(1024) + np.uint64(values[f, 4]), np.uint64(7))
            nx, ny, nz = vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux
            scale = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
            for j in range(math.ceil(length_v / cell_m)):
                for i in range(math.ceil(length_u / cell_m)):
                    look = mixed(np.uint64(numbers[f, 1]), np.uint64(j * 65536 + i))
                    if numbers[f, 0] == 1:  # concrete does not repeat from face to face
                        look = mixed(look, dirt)
                    first = mixed(look, np.uint64(1))
                    u = (i + uniform(first)) * cell_m / length_u
                    v = (j + uniform(mixed(first, look))) * cell_m / length_v
                    if u >= 1.0 or v >= 1.0 or uniform(mixed(look, np.uint64(3))) >= weight:
                        continue
                    if sweep == 1:
                        for axis in range(3):
                            points[count, axis] = quads[f, axis] + u * quads[f, 3 + axis] + v * quads[f, 6 + axis]
                        normals[count, 0], normals[count, 1], normals[count, 2] = nx * scale, ny * scale, nz * scale
                        sizes_m[count] = cell_m * (0.7 + 0.7 * uniform(mixed(look, np.uint64(2))))
                        keys[count, 0], keys[count, 1] = look, dirt
                        place = np.uint64(int(points[count, 0] * 1000.0) + 1048576)
                        place = mixed(place, np.uint64(int(points[count, 1] * 1000.0) + 1048576))
                        place = mixed(place, np.uint64(int(points[count, 2] * 1000.0) + 1048576))
                        keys[count, 2] = mixed(place, look) >> np.uint64(2)
                    count += 1
        if sweep == 0:
            points, normals = np.empty((count, 3)), np.empty((count, 3))
            sizes_m, keys = np.empty(count), np.empty((count, 3), np.uint64)
    return points, normals, sizes_m, keys


@kernel
def visible_from(
    first: int, points: Float, normals: Float, sizes_m: Float, view: Viewpoint, grid: BoxGrid, found: NDArray[np.int32]
) -> int:
    """Number of landmarks from `first` on that a camera may see, their rows in `found`.

    Those in its cone, facing it, of a size that its octaves cover, with no box between.
    """
    cam_from_map, centre, reach_per_m, widest, octave_span = view
    count = 0
    direction = np.empty(3)
    for n in range(first, points.shape[0]):
        dx, dy, dz = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        squared = dx * dx + dy * dy + dz * dz
        reach = sizes_m[n] * reach_per_m
        if squared > reach * reach or squared * octave_span * octave_span < reach * reach:
            continue
        z = cam_from_map[2, 0] * dx + cam_from_map[2, 1] * dy + cam_from_map[2, 2] * dz
        if z < 0.2:
            continue
        x = cam_from_map[0, 0] * dx + cam_from_map[0, 1] * dy + cam_from_map[0, 2] * dz
        y = cam_from_map[1, 0] * dx + cam_from_map[1, 1] * dy + cam_from_map[1, 2] * dz
        if abs(x) > widest[0] * z or abs(y) > widest[1] * z:
            continue
        distance = math.sqrt(squared)
        if dx * normals[n, 0] + dy * normals[n, 1] + dz * normals[n, 2] > -_SMALLEST_COSINE * distance:
            continue
        direction[0], direction[1], direction[2] = dx / distance, dy / distance, dz / distance
        _, box, _ = cast_ray(grid, centre, direction, distance - _OWN_SURFACE_M, True, -1)
        if box < 0:
            found[count] = n
            count += 1
    return count


@kernel
def project(
    points: Float,
    sizes_m: Float,
    rect_from_map: Float,
    pinhole: Float,
    reach_per_m: float,
    pixels: Float,
    octaves: Float,
    distances: Float,
    rows: NDArray[np.int32],
) -> int:
    """Number of points inside the left picture; pixels (N, 3) u_left v u_right, octaves, distances, rows are filled.

    rect_from_map (2, 3, 4): left and right; pinhole (5,): focal cx cy width height. The right camera's own axes give
    u_right.
    """
    count = 0
    left, right = rect_from_map[0], rect_from_map[1]
    per_octave = 1.0 / math.log(1.2)
    for n in range(points.shape[0]):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        z = left[2, 0] * px + left[2, 1] * py + left[2, 2] * pz + left[2, 3]
        if z < 0.2:
            continue
        x = left[0, 0] * px + left[0, 1] * py + left[0, 2] * pz + left[0, 3]
        y = left[1, 0] * px + left[1, 1] * py + left[1, 2] * pz + left[1, 3]
        u, v = pinhole[0] * x / z + pinhole[1], pinhole[0] * y / z + pinhole[2]
        if u < 0.0 or v < 0.0 or u > pinhole[3] - 1 or v > pinhole[4] - 1:
            continue
        distance = math.sqrt(x * x + y * y + z * z)
        octave = math.log(sizes_m[n] * reach_per_m / distance) * per_octave
        if octave < -0.5 or octave > 7.5:
            continue
        z_right = right[2, 0] * px + right[2, 1] * py + right[2, 2] * pz + right[2, 3]
        x_right = right[0, 0] * px + right[0, 1] * py + right[0, 2] * pz + right[0, 3]
        pixels[count, 0], pixels[count, 1] = u, v
        pixels[count, 2] = pinhole[0] * x_right / z_right + pinhole[1]
        octaves[count], distances[count], rows[count] = octave, distance, n
        count += 1
    return count
