"""Discs drawn into a picture, for any lens: each pixel's ray is cut with the disc's plane. Source: Zwicker et al. 2001, splatting."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel

MIN_PIXELS = 0.75  # least radius of a disc, so that no disc falls between the pixels
# What lies so far behind the nearest disc is one surface with it: edges, and what grows with their square. Depths err with the square of
# the distance from which a disc was seen, and its edge grows with that distance.
THICK_EDGES, THICK_PER_M = 3.0, 100.0
_MARGIN = 1.15  # pixels are finer on one side of a disc than in its middle
_MOST_PIXELS = 96.0  # of a disc that the camera touches
Image32 = NDArray[np.float32]


@kernel
def discs_before(
    points_map: NDArray[np.float32], normals_map: NDArray[np.float32], cam_from_map: Array, cone: tuple[float, float],
    numbers: NDArray[np.int64], points_cam: Array,
) -> int:  # fmt: skip
    """How many of the discs (N, 3), with normals (N, 3), face the camera within a cone: the cosine of its half angle, its length in m.

    numbers (N,) and points_cam (N, 3) are filled up to there.
    """
    count = 0
    centre = np.empty(3)
    for axis in range(3):
        turned = cam_from_map[0, axis] * cam_from_map[0, 3] + cam_from_map[1, axis] * cam_from_map[1, 3]
        centre[axis] = -(turned + cam_from_map[2, axis] * cam_from_map[2, 3])
    for i in range(len(points_map)):
        dx, dy, dz = points_map[i, 0] - centre[0], points_map[i, 1] - centre[1], points_map[i, 2] - centre[2]
        squared = dx * dx + dy * dy + dz * dz
        if squared > cone[1] * cone[1] or squared < 1e-4:
            continue
        if normals_map[i, 0] * dx + normals_map[i, 1] * dy + normals_map[i, 2] * dz >= 0.0:
            continue
        depth = cam_from_map[2, 0] * dx + cam_from_map[2, 1] * dy + cam_from_map[2, 2] * dz
        if depth < cone[0] * np.sqrt(squared):
            continue
        numbers[count] = i
        points_cam[count, 0] = cam_from_map[0, 0] * dx + cam_from_map[0, 1] * dy + cam_from_map[0, 2] * dz
        points_cam[count, 1] = cam_from_map[1, 0] * dx + cam_from_map[1, 1] * dy + cam_from_map[1, 2] * dz
        points_cam[count, 2] = depth
        count += 1
    return count


@inner_kernel
def _cut(rays: Array, v: int, u: int, point: Array, normal: Array, through: float) -> tuple[float, float]:
    """Distance along a pixel's ray to the disc's plane, and the square of how far from its centre; (-1, 0) where it meets none."""
    slope = normal[0] * rays[v, u, 0] + normal[1] * rays[v, u, 1] + normal[2] * rays[v, u, 2]
    if not slope < -1e-3:  # True for the NaN of pixels that no ray reaches
        return -1.0, 0.0
    t = through / slope
    x, y, z = t * rays[v, u, 0] - point[0], t * rays[v, u, 1] - point[1], t * rays[v, u, 2] - point[2]
    return t, x * x + y * y + z * z


@kernel
def draw_discs(
    pixels: Array, points_cam: Array, normals_cam: Array, radii_m: Array, edges_m: Array, colours: Array, rays: Array,
    pixels_per_rad: Image32, nearest_m: Image32, weight: Image32, colour: Image32, depth_m: Image32,
) -> None:  # fmt: skip
    """Draws discs (M, 3) with normals, radii (M,), edges of their voxels and colours, whose centres are at pixels (M, 2).

    rays (H, W, 3) of the pixels, unit; pixels_per_rad (H, W): the finest around each. Pictures (H, W): nearest_m comes as inf, the
    others as zeros; colour and depth_m, along the ray, are sums that weight (0: nothing is known) divides.
    """
    rows, columns = rays.shape[:2]
    for is_drawing in (False, True):
        for i in range(len(pixels)):
            point, normal = points_cam[i], normals_cam[i]
            distance = np.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2)
            middle = pixels[i]
            fine = pixels_per_rad[
                int(min(max(middle[1], 0.0), rows - 1.0)), int(min(max(middle[0], 0.0), columns - 1.0))
            ]
            radius_m = max(radii_m[i], MIN_PIXELS * distance / fine)
            reach = min(_MARGIN * radius_m / distance * fine, _MOST_PIXELS)
            first = max(0, int(np.ceil(middle[0] - reach)))
            last = min(columns, int(np.floor(middle[0] + reach)) + 1)
            through = normal[0] * point[0] + normal[1] * point[1] + normal[2] * point[2]
            thick_m = THICK_EDGES * edges_m[i] + THICK_PER_M * edges_m[i] * edges_m[i]
            for v in range(max(0, int(np.ceil(middle[1] - reach))), min(rows, int(np.floor(middle[1] + reach)) + 1)):
                for u in range(first, last):
                    t, squared = _cut(rays, v, u, point, normal, through)
                    share = squared / (radius_m * radius_m)
                    if t <= 0.0 or share >= 1.0:
                        continue
                    if not is_drawing:
                        nearest_m[v, u] = min(nearest_m[v, u], t + thick_m)
                    elif t <= nearest_m[v, u]:
                        w = (1.0 - share) ** 2 / edges_m[i] ** 4 * 1e-8
                        weight[v, u] += w
                        colour[v, u] += w * colours[i]
                        depth_m[v, u] += w * t
