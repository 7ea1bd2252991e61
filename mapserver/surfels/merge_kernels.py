"""Pixels of views merged in voxels, and voxels judged by what views see through.

A voxel's edge is a power of two times EDGE_M, as fine as the pixel that falls into it: what a view shows from afar is kept coarsely.
"""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel

EDGE_M, LEVELS = 0.01, 5
STRIDE = 2  # pixels
MIN_RANGE_M, MAX_RANGE_M = 0.3, 12.0
MAX_SIGMA_SHARE = 0.06  # standard deviation of a depth, as a share of it
_FOOTPRINT_SHARE = 1.5  # least edge of a voxel, in steps from pixel to pixel that merge in it
_FIT_PX, _FIT_STEP_PX, _FIT_APART_PX, _MIN_FIT = (
    6,
    2,
    1.0,
    12,
)  # the square around a pixel whose disparities give the normal
_BITS, _OFFSET = 20, 1 << 19
WEIGHT, OFFSET, NORMAL = 0, 1, 4
SUMS = 7
LAST_VIEW, VIEWS = 0, 1
UNSEEN, SEEN, SEEN_THROUGH = 0, 1, 2


@inner_kernel
def _key(x_m: float, y_m: float, z_m: float, level: int) -> int:
    """The voxel of a point, in 63 bits: 5 km each way at the finest level."""
    edge_m = EDGE_M * (1 << level)
    ix, iy, iz = int(np.floor(x_m / edge_m)), int(np.floor(y_m / edge_m)), int(np.floor(z_m / edge_m))
    return (((level << _BITS | (ix + _OFFSET)) << _BITS | (iy + _OFFSET)) << _BITS) | (iz + _OFFSET)


@kernel
def voxel_keys(points_map: NDArray[np.float64], levels: NDArray[np.uint8], keys: NDArray[np.int64]) -> None:
    """Fills keys (N,) with the voxels of points (N, 3) at these levels (N,)."""
    for i in range(len(points_map)):
        keys[i] = _key(points_map[i, 0], points_map[i, 1], points_map[i, 2], int(levels[i]))


@inner_kernel
def _slot(slots: NDArray[np.int32], keys: NDArray[np.int64], key: int) -> int:
    """Where the table has a key, or has room for it. Source: open addressing, Knuth vol. 3, 6.4; the mixing of splitmix64."""
    mask = np.uint64(len(slots) - 1)
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    place = (mixed ^ (mixed >> np.uint64(29))) & mask
    while slots[np.int64(place)] >= 0 and keys[slots[np.int64(place)]] != key:
        place = (place + np.uint64(1)) & mask
    return int(place)


@kernel
def fill_slots(slots: NDArray[np.int32], keys: NDArray[np.int64], count: int) -> None:
    """Enters the first `count` keys into an empty table, whose size is a power of two."""
    for i in range(count):
        slots[_slot(slots, keys, keys[i])] = i


@inner_kernel
def _normal(disparity_px: NDArray[np.float32], u: int, v: int, lens: Array, normal: Array) -> bool:
    """The normal (3,) in the camera of the plane through the disparities around a pixel, towards the camera; False without one.

    A plane is affine in (u, v, disparity), so that its gradient is its normal; least squares over disparities like the middle one.
    """
    middle = disparity_px[v, u]
    n = su = sv = sd = suu = svv = suv = sud = svd = 0.0
    for dv in range(-_FIT_PX, _FIT_PX + 1, _FIT_STEP_PX):
        for du in range(-_FIT_PX, _FIT_PX + 1, _FIT_STEP_PX):
            if not (0 <= v + dv < disparity_px.shape[0] and 0 <= u + du < disparity_px.shape[1]):
                continue
            d = disparity_px[v + dv, u + du] - middle
            if abs(d) <= _FIT_APART_PX:  # False for NaN
                n, su, sv, sd = n + 1.0, su + du, sv + dv, sd + d
                suu, svv, suv = suu + du * du, svv + dv * dv, suv + du * dv
                sud, svd = sud + du * d, svd + dv * d
    if n < _MIN_FIT:
        return False
    suu, svv, suv = suu - su * su / n, svv - sv * sv / n, suv - su * sv / n
    sud, svd = sud - su * sd / n, svd - sv * sd / n
    determinant = suu * svv - suv * suv
    if determinant <= 1e-6:
        return False
    a, b = (sud * svv - svd * suv) / determinant, (svd * suu - sud * suv) / determinant
    normal[0], normal[1] = -a * lens[0], -b * lens[0]
    normal[2] = -(middle - a * (u - lens[1]) - b * (v - lens[2]))
    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    ray = ((u - lens[1]) / lens[0], (v - lens[2]) / lens[0], 1.0)
    towards = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    if length <= 0.0 or towards >= 0.0:
        return False
    normal /= length
    return True


@inner_kernel
def _level(z_m: float, focal_px: float) -> int:
    """Of a voxel that a camera sees at this depth."""
    level = 0
    while level < LEVELS - 1 and EDGE_M * (1 << level) < _FOOTPRINT_SHARE * STRIDE * z_m / focal_px:
        level += 1
    return level


@kernel
def merge_view(
    disparity_px: NDArray[np.float32], sigma_px: float, lens: Array, map_from_cam: Array, view: int, slots: NDArray[np.int32],
    keys: NDArray[np.int64], sums: NDArray[np.float32], views: NDArray[np.int32], count: int,
) -> int:  # fmt: skip
    """Adds one view's points to the voxels, of which there are `count`; returns how many there are then.

    disparity_px (H, W), NaN unknown; lens (4,) as of StereoCamera; map_from_cam (4, 4). slots: see fill_slots. keys (M,), sums (M, SUMS),
    views (M, 2) with room for a voxel of every pixel. Points and normals are means by the inverse variance of the depth.
    """
    rows, columns = disparity_px.shape
    normal = np.empty(3)
    point, turned = np.empty(3), np.empty(3)
    for v in range(0, rows, STRIDE):
        for u in range(0, columns, STRIDE):
            if not disparity_px[v, u] > 0.0:
                continue
            z = lens[3] / disparity_px[v, u]
            sigma_m = z * z / lens[3] * sigma_px
            if not MIN_RANGE_M <= z <= MAX_RANGE_M or sigma_m > MAX_SIGMA_SHARE * z:
                continue
            if not _normal(disparity_px, u, v, lens, normal):
                continue
            level = _level(z, lens[0])
            x, y = (u - lens[1]) * z / lens[0], (v - lens[2]) * z / lens[0]
            for axis in range(3):
                row = map_from_cam[axis]
                point[axis] = row[0] * x + row[1] * y + row[2] * z + row[3]
                turned[axis] = row[0] * normal[0] + row[1] * normal[1] + row[2] * normal[2]
            key = _key(point[0], point[1], point[2], level)
            slot = _slot(slots, keys, key)
            i = int(slots[slot])
            if i < 0:
                i, count = count, count + 1
                slots[slot], keys[i] = i, key
                sums[i] = 0.0
                views[i] = -1, 0
            edge_m, weight = EDGE_M * (1 << level), 1e-4 / (sigma_m * sigma_m)
            sums[i, WEIGHT] += weight
            for axis in range(3):
                sums[i, OFFSET + axis] += weight * (point[axis] - np.floor(point[axis] / edge_m) * edge_m)
                sums[i, NORMAL + axis] += weight * turned[axis]
            if views[i, LAST_VIEW] != view:
                views[i, LAST_VIEW], views[i, VIEWS] = view, views[i, VIEWS] + 1
    return count


@kernel
def look_at(
    points_map: NDArray[np.float32], levels: NDArray[np.uint8], nearest_px: NDArray[np.float32], step_px: int, sigma_px: float,
    lens: Array, cam_from_map: Array, clear: tuple[float, float], marks: NDArray[np.uint8], weights: NDArray[np.float32],
    pixels: NDArray[np.float32],
) -> None:  # fmt: skip
    """What a view shows of points (N, 3) of voxels of these levels (N,): marks (N,) SEEN, SEEN_THROUGH or UNSEEN.

    nearest_px (h, w): every step_px-th pixel's largest disparity around it, 0 where its own is unknown. clear: standard deviations of
    the depth, and metres, that a point must lie before what the pixel shows to be seen through. weights (N,): how many views a view
    counts for that sees more finely than the voxel was seen. pixels (N, 2), of points that are seen.
    """
    for i in range(len(points_map)):
        marks[i] = UNSEEN
        x, y, z = points_map[i, 0], points_map[i, 1], points_map[i, 2]
        depth_m = cam_from_map[2, 0] * x + cam_from_map[2, 1] * y + cam_from_map[2, 2] * z + cam_from_map[2, 3]
        if not MIN_RANGE_M < depth_m < MAX_RANGE_M:
            continue
        right = cam_from_map[0, 0] * x + cam_from_map[0, 1] * y + cam_from_map[0, 2] * z + cam_from_map[0, 3]
        down = cam_from_map[1, 0] * x + cam_from_map[1, 1] * y + cam_from_map[1, 2] * z + cam_from_map[1, 3]
        pixels[i, 0], pixels[i, 1] = lens[0] * right / depth_m + lens[1], lens[0] * down / depth_m + lens[2]
        u, v = int(np.floor(pixels[i, 0] / step_px + 0.5)), int(np.floor(pixels[i, 1] / step_px + 0.5))
        if not (0 <= u < nearest_px.shape[1] and 0 <= v < nearest_px.shape[0]) or not nearest_px[v, u] > 0.0:
            continue
        shown_m = lens[3] / nearest_px[v, u]
        clear_m = clear[0] * shown_m * shown_m / lens[3] * sigma_px + clear[1]
        finer = max(0, int(levels[i]) - _level(depth_m, lens[0]))
        weights[i] = 1 << (2 * finer)
        if depth_m < shown_m - clear_m:
            marks[i] = SEEN_THROUGH
        elif depth_m < shown_m + clear_m:
            marks[i] = SEEN
