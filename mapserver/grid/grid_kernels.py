"""Rays of one view through the cells of a window, and views summed to what a session saw.

A cell is a square column of the map: below the floor margin it is floor, above it stand SLICES voxels of SLICE_M each. Within
one view a voxel is hit, passed or not seen, so that a view counts once, however many of its pixels fall into a voxel.
"""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.mapformat.grid_tile import CELL_M
from fleetmap.numerics.kernel import inner_kernel, kernel
from fleetmap.version_grid import FLOOR_M, HEIGHT_STEP_M, LOWEST_M, SLICE_M, SLICES, Counts

BELOW_M = 0.15  # what lies deeper is a mirror image in the floor, or a wrong disparity
HIT_STRIDE, RAY_STRIDE = 2, 4  # pixels
MAX_HIT_SIGMA_M = 0.08  # of the depth: beyond, points say only what is free before them
CLEAR_SIGMAS = 3.0  # and a cell: so far before a point its ray no longer proves a voxel free
_MIN_POINTS = 6  # of a view in a voxel that it hits
_MOST = 255
PASSED, HIDDEN = 1, 2


@kernel
def cast_view(
    disparity_px: NDArray[np.float32], nearest_px: NDArray[np.float32], sigma_px: float, lens: Array, map_from_cam: Array, camera: Array,
    was_free: Counts, points: NDArray[np.uint16], looks: Counts, heights: Counts,
) -> None:  # fmt: skip
    """Fills the window of one view, which comes as zeros.

    disparity_px (H, W), NaN unknown, with standard deviation sigma_px; nearest_px (H, W): the largest around each, beyond whose
    depth nothing is proved free. lens (4,) as of StereoCamera. map_from_cam (3, 3) rotation. camera (3,): its x and y in cells of
    the window, and its height over the floor in metres. was_free (R, C): bits of the voxels that were free before this recording,
    and all around them. points (R, C, SLICES): pixels in each voxel. looks (R, C, SLICES): PASSED where a ray went through, up to a
    clear distance before its point, and to the floor itself; HIDDEN behind points where nothing was before. heights (R, C, 2): codes
    of the lowest and the highest of the points in hit voxels and on the floor.
    Cells of a ray: Amanatides and Woo 1987; a voxel is that of the ray's height in the middle of its way through a cell.
    """
    rows, columns = disparity_px.shape
    end = np.empty(3)
    for v in range(0, rows, HIT_STRIDE):
        for u in range(0, columns, HIT_STRIDE):
            if not _point(disparity_px[v, u], u, v, lens, map_from_cam, camera, end):
                continue
            depth_m = lens[3] / disparity_px[v, u]
            sigma_m = depth_m * depth_m / lens[3] * sigma_px
            is_near, is_floor = sigma_m <= MAX_HIT_SIGMA_M, end[2] < FLOOR_M
            if is_near and not is_floor:
                row, column, level = int(np.floor(end[1])), int(np.floor(end[0])), int((end[2] - FLOOR_M) / SLICE_M)
                inside = 0 <= row < points.shape[0] and 0 <= column < points.shape[1]
                if inside and level < SLICES:
                    points[row, column, level] += points[row, column, level] < 65535
                    if v % RAY_STRIDE == 0 and u % RAY_STRIDE == 0 and was_free[row, column] >> level & 1:
                        _walk(camera, end, (1.0, np.inf), HIDDEN, looks)
            if v % RAY_STRIDE == 0 and u % RAY_STRIDE == 0:
                clear_m = 0.0 if is_near and is_floor else CLEAR_SIGMAS * sigma_m + CELL_M
                free_m = min(depth_m - clear_m, lens[3] / nearest_px[v, u])
                if free_m > 0.0:
                    _walk(camera, end, (0.0, free_m / depth_m), PASSED, looks)
    for v in range(0, rows, HIT_STRIDE):
        for u in range(0, columns, HIT_STRIDE):
            if not _point(disparity_px[v, u], u, v, lens, map_from_cam, camera, end):
                continue
            depth_m = lens[3] / disparity_px[v, u]
            if depth_m * depth_m / lens[3] * sigma_px > MAX_HIT_SIGMA_M:
                continue
            row, column = int(np.floor(end[1])), int(np.floor(end[0]))
            if not (0 <= row < points.shape[0] and 0 <= column < points.shape[1]):
                continue
            level = int((end[2] - FLOOR_M) / SLICE_M) if end[2] >= FLOOR_M else -1
            if level < SLICES and (level < 0 or points[row, column, level] >= _MIN_POINTS):
                code = 1 + int((end[2] - LOWEST_M) / HEIGHT_STEP_M)
                if heights[row, column, 0] == 0 or code < heights[row, column, 0]:
                    heights[row, column, 0] = code
                heights[row, column, 1] = max(heights[row, column, 1], code)


@inner_kernel
def _point(disparity_px: float, u: int, v: int, lens: Array, map_from_cam: Array, camera: Array, end: Array) -> bool:
    """Where a pixel's point is: end (3,) as camera. False where there is none, or one below the floor."""
    if not disparity_px > 0.0:
        return False
    z = lens[3] / disparity_px
    x, y = (u - lens[1]) * z / lens[0], (v - lens[2]) * z / lens[0]
    for axis in range(3):
        moved = map_from_cam[axis, 0] * x + map_from_cam[axis, 1] * y + map_from_cam[axis, 2] * z
        end[axis] = camera[axis] + (moved if axis == 2 else moved / CELL_M)
    return bool(end[2] >= -BELOW_M)


@inner_kernel
def _walk(camera: Array, end: Array, shares: tuple[float, float], mark: int, looks: Counts) -> None:
    """Marks the voxels of a ray from camera to end between these shares of its length, which may lie behind its end."""
    first, until = shares
    along_x, along_y, rise_m = end[0] - camera[0], end[1] - camera[1], end[2] - camera[2]
    column, row = int(np.floor(camera[0])), int(np.floor(camera[1]))
    step_x, step_y = (1 if along_x > 0 else -1), (1 if along_y > 0 else -1)
    each_x = abs(1.0 / along_x) if along_x != 0.0 else np.inf
    each_y = abs(1.0 / along_y) if along_y != 0.0 else np.inf
    next_x = (column + (1 if step_x > 0 else 0) - camera[0]) / along_x if along_x != 0.0 else np.inf
    next_y = (row + (1 if step_y > 0 else 0) - camera[1]) / along_y if along_y != 0.0 else np.inf
    begun = 0.0
    while begun < until and 0 <= row < looks.shape[0] and 0 <= column < looks.shape[1]:
        ended = min(next_x, next_y, until)
        height_m = camera[2] + 0.5 * (begun + ended) * rise_m
        if begun > 1.0 and height_m < 0.0:
            return
        level = int((height_m - FLOOR_M) / SLICE_M) if height_m >= FLOOR_M else 0
        if level < SLICES and begun >= first:
            looks[row, column, level] |= mark
        if next_x < next_y:
            begun, column, next_x = next_x, column + step_x, next_x + each_x
        else:
            begun, row, next_y = next_y, row + step_y, next_y + each_y


@kernel
def add_view(
    points: NDArray[np.uint16], looks: Counts, heights: Counts, corner: NDArray[np.int64], tile_hits: Counts, tile_passes: Counts,
    tile_hidden: Counts, tile_heights: Counts,
) -> None:  # fmt: skip
    """Adds a window to a tile (N, N, ...) whose cell (0, 0) is the window's cell `corner` (row, column); counts stop at 255.

    tile_heights (N, N, 4): the two lowest and the two highest codes of all views; the second of each is believed, as one
    view may err.
    """
    size = tile_hits.shape[0]
    for row in range(max(0, -corner[0]), min(size, points.shape[0] - corner[0])):
        for column in range(max(0, -corner[1]), min(size, points.shape[1] - corner[1])):
            r, c = row + corner[0], column + corner[1]
            for level in range(SLICES):
                if points[r, c, level] >= _MIN_POINTS:
                    tile_hits[row, column, level] = min(tile_hits[row, column, level] + 1, _MOST)
                elif looks[r, c, level] & PASSED:
                    tile_passes[row, column, level] = min(tile_passes[row, column, level] + 1, _MOST)
                elif looks[r, c, level] & HIDDEN:
                    tile_hidden[row, column, level] = min(tile_hidden[row, column, level] + 1, _MOST)
            low, high = heights[r, c, 0], heights[r, c, 1]
            if low:
                known = tile_heights[row, column]
                if known[0] == 0 or low < known[0]:
                    known[0], known[1] = low, known[0]
                elif known[1] == 0 or low < known[1]:
                    known[1] = low
                if high > known[2]:
                    known[2], known[3] = high, known[2]
                elif high > known[3]:
                    known[3] = high
