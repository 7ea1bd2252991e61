"""Discs drawn into a picture, for any lens: each pixel's ray is cut with the disc's plane. Source: Zwicker et al. 2001, splatting."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import uncounted_inner_kernel, uncounted_kernel
from mapserver.surfels.merge_kernels import EDGE_M

MIN_PIXELS = 0.75  # least radius of a disc, so that no disc falls between the pixels
# What lies so far behind the nearest disc is one surface with it: edges, and what grows with their square. Depths err with the square of
# the distance from which a disc was seen, and its edge grows with that distance.
THICK_EDGES, THICK_PER_M = 3.0, 100.0
_MARGIN = 1.15  # pixels are finer on one side of a disc than in its middle
_MOST_PIXELS = 96.0  # of a disc that the camera touches
RIM = 0.1  # of the width: discs whose centre is so far outside may reach in
BINS = 64  # of distances
BLOCK_PX, _LOOKS = 8, 24  # squares of pixels whose farthest surface is known, and how often it is looked for
Image32 = NDArray[np.float32]


@uncounted_kernel
def discs_before(
    points_map: NDArray[np.float32], normals_map: NDArray[np.float32], cam_from_map: Array, cone: tuple[float, float], pinhole: Array,
    size_px: tuple[int, int], numbers: NDArray[np.int32], points_cam: Array, pixels: Array,
) -> int:  # fmt: skip
    """How many of the discs (N, 3), with normals (N, 3), face the camera within a cone: the cosine of its half angle, its length in m.

    numbers (N,) and points_cam (N, 3) are filled up to there. pinhole (4,): fx, fy, cx, cy of a lens that bends nothing, for which
    pixels (N, 2) are filled too and only discs near the picture of size_px (width, height) are taken; zeros for any other.
    """
    count = 0
    cx = -(
        cam_from_map[0, 0] * cam_from_map[0, 3]
        + cam_from_map[1, 0] * cam_from_map[1, 3]
        + cam_from_map[2, 0] * cam_from_map[2, 3]
    )
    cy = -(
        cam_from_map[0, 1] * cam_from_map[0, 3]
        + cam_from_map[1, 1] * cam_from_map[1, 3]
        + cam_from_map[2, 1] * cam_from_map[2, 3]
    )
    cz = -(
        cam_from_map[0, 2] * cam_from_map[0, 3]
        + cam_from_map[1, 2] * cam_from_map[1, 3]
        + cam_from_map[2, 2] * cam_from_map[2, 3]
    )
    rim = RIM * size_px[0]
    for i in range(len(points_map)):
        dx, dy, dz = points_map[i, 0] - cx, points_map[i, 1] - cy, points_map[i, 2] - cz
        squared = dx * dx + dy * dy + dz * dz
        if squared > cone[1] * cone[1] or squared < 1e-4:
            continue
        if normals_map[i, 0] * dx + normals_map[i, 1] * dy + normals_map[i, 2] * dz >= 0.0:
            continue
        depth = cam_from_map[2, 0] * dx + cam_from_map[2, 1] * dy + cam_from_map[2, 2] * dz
        if depth < cone[0] * np.sqrt(squared):
            continue
        right = cam_from_map[0, 0] * dx + cam_from_map[0, 1] * dy + cam_from_map[0, 2] * dz
        down = cam_from_map[1, 0] * dx + cam_from_map[1, 1] * dy + cam_from_map[1, 2] * dz
        if pinhole[0] > 0.0:
            if depth < 1e-9:
                continue
            u, v = pinhole[0] * right / depth + pinhole[2], pinhole[1] * down / depth + pinhole[3]
            if not (-rim < u < size_px[0] + rim and -rim < v < size_px[1] + rim):
                continue
            pixels[count, 0], pixels[count, 1] = u, v
        numbers[count] = i
        points_cam[count, 0], points_cam[count, 1], points_cam[count, 2] = right, down, depth
        count += 1
    return count


@uncounted_kernel
def near_to_far(points_cam: Array, far_m: float, counts: NDArray[np.int64], order: NDArray[np.int32]) -> None:
    """Fills order (M,) with the numbers of points (M, 3), by bins of distance. counts (BINS + 1,) comes as zeros."""
    for i in range(len(points_cam)):
        counts[_bin(points_cam, i, far_m) + 1] += 1
    for b in range(1, len(counts)):
        counts[b] += counts[b - 1]
    for i in range(len(points_cam)):
        b = _bin(points_cam, i, far_m)
        order[counts[b]] = i
        counts[b] += 1


@uncounted_inner_kernel
def _bin(points_cam: Array, i: int, far_m: float) -> int:
    squared = points_cam[i, 0] ** 2 + points_cam[i, 1] ** 2 + points_cam[i, 2] ** 2
    return min(int(BINS * np.sqrt(np.sqrt(squared) / far_m)), BINS - 1)


@uncounted_inner_kernel
def _look(nearest_m: Image32, hidden_m: Image32) -> None:
    """Fills hidden_m with the farthest of nearest_m in each block: what lies behind it is seen nowhere there."""
    for row in range(hidden_m.shape[0]):
        for column in range(hidden_m.shape[1]):
            hidden_m[row, column] = 0.0
    for v in range(nearest_m.shape[0]):
        for u in range(nearest_m.shape[1]):
            row, column = v // BLOCK_PX, u // BLOCK_PX
            hidden_m[row, column] = max(hidden_m[row, column], nearest_m[v, u])


@uncounted_kernel
def draw_discs(
    order: NDArray[np.int32], numbers: NDArray[np.int32], pixels: Array, points_cam: Array, cam_from_map: Array,
    normals_map: Image32, levels: NDArray[np.uint8], colours: NDArray[np.uint8], radius_edges: float, rays: Array, pixels_per_rad: Image32,
    hidden_m: Image32, nearest_m: Image32, weight: Image32, colour: Image32, depth_m: Image32,
) -> None:  # fmt: skip
    """Draws discs, those first that come first in order (M,): near to far is fastest, since what is hidden by then costs little.

    numbers (M,) of their normals (N, 3), levels of voxels (N,) and colours (N,); points (M, 3), and pixels (M, 2) of their centres. Radii
    are so many edges. rays (H, W, 3) of the pixels, unit; pixels_per_rad (H, W): the finest around each. hidden_m has room for a number
    of every block. Pictures (H, W): nearest_m comes as inf, the others as zeros; colour and depth_m, along the ray, are sums that
    weight (0: nothing is known) divides.
    """
    rows, columns = rays.shape[0], rays.shape[1]
    step = len(order) // _LOOKS + 1
    for is_drawing in (False, True):
        for k in range(len(order)):
            if k % step == 0 and not (is_drawing and k):
                _look(nearest_m, hidden_m)
            i = order[k]
            n = numbers[i]
            x, y, z = points_cam[i, 0], points_cam[i, 1], points_cam[i, 2]
            distance = np.sqrt(x * x + y * y + z * z)
            middle_u, middle_v = pixels[i, 0], pixels[i, 1]
            fine = pixels_per_rad[int(min(max(middle_v, 0.0), rows - 1.0)), int(min(max(middle_u, 0.0), columns - 1.0))]
            edge_m = EDGE_M * (1 << int(levels[n]))
            radius_m = max(radius_edges * edge_m, MIN_PIXELS * distance / fine)
            reach = min(_MARGIN * radius_m / distance * fine, _MOST_PIXELS)
            first_u, last_u = max(0, int(np.ceil(middle_u - reach))), min(columns, int(np.floor(middle_u + reach)) + 1)
            first_v, last_v = max(0, int(np.ceil(middle_v - reach))), min(rows, int(np.floor(middle_v + reach)) + 1)
            if first_u >= last_u or first_v >= last_v:
                continue
            thick_m = THICK_EDGES * edge_m + THICK_PER_M * edge_m * edge_m
            # Nothing of the disc is nearer than this. What float32 rounds away is added.
            least_m = 0.99999 * (distance - radius_m + (0.0 if is_drawing else thick_m))
            is_hidden = True
            for row in range(first_v // BLOCK_PX, (last_v - 1) // BLOCK_PX + 1):
                for column in range(first_u // BLOCK_PX, (last_u - 1) // BLOCK_PX + 1):
                    is_hidden &= least_m > hidden_m[row, column]
            if is_hidden:
                continue
            nx = (
                cam_from_map[0, 0] * normals_map[n, 0]
                + cam_from_map[0, 1] * normals_map[n, 1]
                + cam_from_map[0, 2] * normals_map[n, 2]
            )
            ny = (
                cam_from_map[1, 0] * normals_map[n, 0]
                + cam_from_map[1, 1] * normals_map[n, 1]
                + cam_from_map[1, 2] * normals_map[n, 2]
            )
            nz = (
                cam_from_map[2, 0] * normals_map[n, 0]
                + cam_from_map[2, 1] * normals_map[n, 1]
                + cam_from_map[2, 2] * normals_map[n, 2]
            )
            through, per_squared = nx * x + ny * y + nz * z, 1.0 / (radius_m * radius_m)
            factor = 1e-8 / (edge_m * edge_m * edge_m * edge_m)
            for v in range(first_v, last_v):
                for u in range(first_u, last_u):
                    ray_x, ray_y, ray_z = rays[v, u, 0], rays[v, u, 1], rays[v, u, 2]
                    slope = nx * ray_x + ny * ray_y + nz * ray_z
                    if not slope < -1e-3:  # True for the NaN of pixels that no ray reaches
                        continue
                    t = through / slope
                    off_x, off_y, off_z = t * ray_x - x, t * ray_y - y, t * ray_z - z
                    share = (off_x * off_x + off_y * off_y + off_z * off_z) * per_squared
                    if t <= 0.0 or share >= 1.0:
                        continue
                    if not is_drawing:
                        nearest_m[v, u] = min(nearest_m[v, u], t + thick_m)
                    elif t <= nearest_m[v, u]:
                        w = (1.0 - share) * (1.0 - share) * factor
                        weight[v, u] += w
                        colour[v, u] += w * colours[n]
                        depth_m[v, u] += w * t
