"""Inner loops of the tracker: prediction of points, and their agreement with one motion."""

import math

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel
from fleetmap.pnp.pnp_kernels import refine_twice

_NEAR_M = 1e-6
Refinement = tuple[float, float, tuple[int, int]]  # of `pnp`: width, gate, iterations


@inner_kernel
def _moved(motion: Array, x: float, y: float, z: float, is_point: bool) -> tuple[float, float, float]:
    """A point by a transform (4, 4), a direction by its rotation alone."""
    shift = 1.0 if is_point else 0.0
    return (
        motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z + shift * motion[0, 3],
        motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z + shift * motion[1, 3],
        motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z + shift * motion[2, 3],
    )


@kernel
def stereo_points(pixels: Array, camera: Array, points_cam: Array) -> None:
    """Fills points_cam (N, 3) of pixels (N, 3) u_left v u_right; not finite where there is no disparity."""
    for n in range(len(pixels)):
        z = camera[3] / (pixels[n, 0] - pixels[n, 2])
        points_cam[n, 0], points_cam[n, 1] = (
            (pixels[n, 0] - camera[1]) * z / camera[0],
            (pixels[n, 1] - camera[2]) * z / camera[0],
        )
        points_cam[n, 2] = z


@kernel
def motion_of(
    points_cam: Array,
    flowed: Array,
    kept: NDArray[np.bool_],
    camera: Array,
    least: int,
    refinement: Refinement,
    cam_from_previous: Array,
    information: Array,
    squared: Array,
) -> tuple[int, int]:
    """How many points (N, 3) with depth were kept (N,), and how many of these agree with the motion that flowed (N, 2) shows.

    -1 agree where they determine none, or are fewer than `least`. cam_from_previous (4, 4) goes from a guess to the motion;
    information (6, 6) and squared (N,), of the points with depth, are filled as by `refine_twice`.
    """
    count, rows = 0, np.empty(len(kept), np.int64)
    for n in range(len(kept)):
        known = math.isfinite(points_cam[n, 0]) and math.isfinite(points_cam[n, 1]) and math.isfinite(points_cam[n, 2])
        if kept[n] and known:
            rows[count] = n
            count += 1
    if count < least:
        return count, -1
    points, measured = np.empty((count, 3)), np.full((count, 3), np.nan)
    for k in range(count):
        measured[k, 0], measured[k, 1] = flowed[rows[k], 0], flowed[rows[k], 1]
        for a in range(3):
            points[k, a] = points_cam[rows[k], a]
    width, gate_squared, iterations = refinement
    rotation, translation = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        translation[a] = cam_from_previous[a, 3]
        for b in range(3):
            rotation[a, b] = cam_from_previous[a, b]
    if not refine_twice(
        rotation, translation, points, measured, np.ones((count, 2)), camera, width, gate_squared, np.zeros((6, 6)),
        iterations, information, squared[:count],
    ):  # fmt: skip
        return count, -1
    agree = 0
    for k in range(count):
        agree += squared[k] < gate_squared
    for a in range(3):
        cam_from_previous[a, 3] = translation[a]
        for b in range(3):
            cam_from_previous[a, b] = rotation[a, b]
    return count, agree


@kernel
def predict(points_cam: Array, pixels: Array, cam_from_previous: Array, camera: Array, predicted: Array) -> None:
    """Fills predicted (N, 2): where the previous frame's points should appear.

    points_cam (N, 3), NaN where the depth is unknown: such points move as if far away. pixels (N, 3) of the previous frame; those
    that would come to lie behind the camera stay. camera: focal, cx, cy, focal * baseline.
    """
    for n in range(len(pixels)):
        x, y, z = points_cam[n, 0], points_cam[n, 1], points_cam[n, 2]
        known = math.isfinite(x) and math.isfinite(y) and math.isfinite(z)
        if not known:
            x, y, z = (pixels[n, 0] - camera[1]) / camera[0], (pixels[n, 1] - camera[2]) / camera[0], 1.0
        x, y, z = _moved(cam_from_previous, x, y, z, known)
        if z > _NEAR_M:
            predicted[n, 0], predicted[n, 1] = camera[0] * x / z + camera[1], camera[0] * y / z + camera[2]
        else:
            predicted[n, 0], predicted[n, 1] = pixels[n, 0], pixels[n, 1]


@kernel
def carry(
    points_cam: Array,
    pixels: Array,
    flowed: Array,
    cam_from_previous: Array,
    camera: Array,
    limit_px: float,
    kept: NDArray[np.bool_],
    carried: Array,
) -> None:
    """Ends in `kept` (N,) what flowed (N, 2) further than the limit from where the motion takes it; fills carried (N, 3).

    That is flowed, and the right image's u by the depth that the motion leaves, NaN where unknown. Other arguments as of
    `predict`. What has no depth cannot disagree.
    """
    predicted = np.empty((len(pixels), 2))
    predict(points_cam, pixels, cam_from_previous, camera, predicted)
    for n in range(len(pixels)):
        x, y, z = points_cam[n, 0], points_cam[n, 1], points_cam[n, 2]
        carried[n, 0], carried[n, 1], carried[n, 2] = flowed[n, 0], flowed[n, 1], np.nan
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            continue
        off_u, off_v = predicted[n, 0] - flowed[n, 0], predicted[n, 1] - flowed[n, 1]
        if not math.sqrt(off_u * off_u + off_v * off_v) < limit_px:
            kept[n] = False
        depth = _moved(cam_from_previous, x, y, z, True)[2]
        if depth > 0.0 and camera[3] > 0.0:
            carried[n, 2] = flowed[n, 0] - camera[3] / depth


@kernel
def ways_of_common(
    old_ids: NDArray[np.int64], old_pixels: Array, ids: NDArray[np.int64], pixels: Array, ways_px: Array
) -> int:
    """Number of ids in both, ascending, lists; fills how far the pixels (N, 3) of each have moved so far in ways_px (N,)."""
    count, k = 0, 0
    for n in range(len(ids)):
        while k < len(old_ids) and old_ids[k] < ids[n]:
            k += 1
        if k == len(old_ids):
            break
        if old_ids[k] == ids[n]:
            u, v = pixels[n, 0] - old_pixels[k, 0], pixels[n, 1] - old_pixels[k, 1]
            ways_px[count] = math.sqrt(u * u + v * v)
            count += 1
    return count
