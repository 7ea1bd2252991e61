"""Which landmarks a camera should see: one pass over all of a map view, nothing kept for those that it does not."""

import math

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel


@kernel
def visible(
    points_map: Array, view_directions_map: NDArray[np.float32], view_half_angles_rad: NDArray[np.float32],
    reaches_m: NDArray[np.float32], map_from_cam: Array, pinhole: Array, margin_px: float, max_view_angle_rad: float,
    nearest_m: float, reach_share: float, rows: NDArray[np.int64], pixels: Array, distances_m: Array,
) -> int:  # fmt: skip
    """Number of landmarks in the picture widened by margin_px; fills their rows, pixels (N, 3) and distances (N,) so far.

    A landmark counts between nearest_m and reach_share of its reach, seen at most max_view_angle_rad outside the cone of
    directions (N, 3) from which it was mapped. pinhole: focal, cx, cy, focal * baseline, width, height. All arrays are of
    the map's N landmarks.
    """
    focal, right, bottom = pinhole[0], pinhole[4] + margin_px, pinhole[5] + margin_px
    count = 0
    for n in range(len(points_map)):
        x, y, z = (
            points_map[n, 0] - map_from_cam[0, 3],
            points_map[n, 1] - map_from_cam[1, 3],
            points_map[n, 2] - map_from_cam[2, 3],
        )
        depth = map_from_cam[0, 2] * x + map_from_cam[1, 2] * y + map_from_cam[2, 2] * z
        if not depth > 1e-6:
            continue
        u = focal * (map_from_cam[0, 0] * x + map_from_cam[1, 0] * y + map_from_cam[2, 0] * z) / depth + pinhole[1]
        v = focal * (map_from_cam[0, 1] * x + map_from_cam[1, 1] * y + map_from_cam[2, 1] * z) / depth + pinhole[2]
        if not (-margin_px < u < right and -margin_px < v < bottom):
            continue
        distance = math.sqrt(x * x + y * y + z * z)
        if not nearest_m < distance < reach_share * reaches_m[n]:
            continue
        towards = x * view_directions_map[n, 0] + y * view_directions_map[n, 1] + z * view_directions_map[n, 2]
        if not -towards / distance > math.cos(min(view_half_angles_rad[n] + max_view_angle_rad, math.pi)):
            continue
        rows[count], distances_m[count] = n, distance
        pixels[count, 0], pixels[count, 1], pixels[count, 2] = u, v, u - pinhole[3] / depth
        count += 1
    return count
