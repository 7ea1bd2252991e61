"""The landmarks that a camera should see, in one pass over a map: nothing is kept for the others."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

_NEAREST_M = 0.2
_REACH_SHARE = 1.3  # of the distance up to which a landmark was found: detection does not end sharply


class ViewingCones(NamedTuple):
    """The directions and distances from which N landmarks were seen.

    points_map (N, 3); directions_map (N, 3) unit, from the landmark to the cameras that saw it; half_angles_rad (N,) around them;
    max_distances_m (N,) at which it appears at the finest octave, 0 for one that nothing has seen.
    """

    points_map: Array
    directions_map: NDArray[np.float32]
    half_angles_rad: NDArray[np.float32]
    max_distances_m: NDArray[np.float32]


@kernel
def visible(
    cones: ViewingCones, map_from_cam: Array, pinhole: Array, margin_px: float, max_view_angle_rad: float
) -> tuple[NDArray[np.int64], Array, Array]:
    """Rows (V,), pixels (V, 3) and distances (V,) of the landmarks in the image widened by margin_px.

    max_view_angle_rad: how far outside its cone a landmark may be seen. pinhole: focal, cx, cy, focal * baseline, width, height.
    """
    size = len(cones.points_map)
    rows, pixels, distances_m = np.empty(size, np.int64), np.empty((size, 3)), np.empty(size)
    points_map, directions_map = cones.points_map, cones.directions_map
    focal, right, bottom = pinhole[0], pinhole[4] + margin_px, pinhole[5] + margin_px
    count = 0
    for n in range(size):
        x = points_map[n, 0] - map_from_cam[0, 3]
        y = points_map[n, 1] - map_from_cam[1, 3]
        z = points_map[n, 2] - map_from_cam[2, 3]
        depth = map_from_cam[0, 2] * x + map_from_cam[1, 2] * y + map_from_cam[2, 2] * z
        if not depth > 1e-6:
            continue
        u = focal * (map_from_cam[0, 0] * x + map_from_cam[1, 0] * y + map_from_cam[2, 0] * z) / depth + pinhole[1]
        v = focal * (map_from_cam[0, 1] * x + map_from_cam[1, 1] * y + map_from_cam[2, 1] * z) / depth + pinhole[2]
        if not (-margin_px < u < right and -margin_px < v < bottom):
            continue
        distance = math.sqrt(x * x + y * y + z * z)
        if not _NEAREST_M < distance < _REACH_SHARE * cones.max_distances_m[n]:
            continue
        towards = x * directions_map[n, 0] + y * directions_map[n, 1] + z * directions_map[n, 2]
        if not -towards / distance > math.cos(min(cones.half_angles_rad[n] + max_view_angle_rad, math.pi)):
            continue
        rows[count], distances_m[count] = n, distance
        pixels[count, 0], pixels[count, 1], pixels[count, 2] = u, v, u - pinhole[3] / depth
        count += 1
    return rows[:count].copy(), pixels[:count].copy(), distances_m[:count].copy()
