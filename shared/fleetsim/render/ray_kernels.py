"""Rays against yawed boxes in a uniform grid: for baking light, and in the tests to check the painter."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.numerics.kernel import kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Int32 = NDArray[np.int32]
_FAR = 1e30


class BoxGrid(NamedTuple):
    """Boxes (B, 8) as in `Faces` in a uniform grid of counts (3,) cells from the corner `low` (3,) on, as CSR lists."""

    boxes: Float
    low: Float
    cell_m: float
    counts: Int
    starts: Int32
    items: Int32


def box_grid(boxes: Float, low: Float, high: Float, cell_m: float) -> BoxGrid:
    """The grid of boxes between two corners (3,)."""
    counts = np.ceil((high - low) / cell_m).astype(np.int64)
    return BoxGrid(boxes, low, cell_m, counts, *fill_grid(boxes, low, cell_m, counts))


@kernel
def fill_grid(boxes: Float, low: Float, cell_m: float, counts: Int) -> tuple[Int32, Int32]:
    """CSR lists of the boxes (B, 8) that touch each cell: starts (cells + 1,), items.

    Boxes outside the grid are clamped out.
    """
    starts = np.zeros(counts[0] * counts[1] * counts[2] + 1, np.int32)
    items = np.empty(0, np.int32)
    cursor = starts
    for sweep in range(2):
        if sweep == 1:
            starts = np.cumsum(starts).astype(np.int32)
            items = np.empty(starts[-1], np.int32)
            cursor = starts.copy()
        for b in range(boxes.shape[0]):
            reach_x = abs(boxes[b, 6]) * boxes[b, 3] + abs(boxes[b, 7]) * boxes[b, 4]
            reach_y = abs(boxes[b, 7]) * boxes[b, 3] + abs(boxes[b, 6]) * boxes[b, 4]
            i0 = max(0, math.floor((boxes[b, 0] - reach_x - low[0]) / cell_m))
            i1 = min(counts[0] - 1, math.floor((boxes[b, 0] + reach_x - low[0]) / cell_m))
            j0 = max(0, math.floor((boxes[b, 1] - reach_y - low[1]) / cell_m))
            j1 = min(counts[1] - 1, math.floor((boxes[b, 1] + reach_y - low[1]) / cell_m))
            k0 = max(0, math.floor((boxes[b, 2] - boxes[b, 5] - low[2]) / cell_m))
            k1 = min(counts[2] - 1, math.floor((boxes[b, 2] + boxes[b, 5] - low[2]) / cell_m))
            for k in range(k0, k1 + 1):
                for j in range(j0, j1 + 1):
                    for i in range(i0, i1 + 1):
                        cell = (k * counts[1] + j) * counts[0] + i
                        if sweep == 0:
                            starts[cell + 1] += 1
                        else:
                            items[cursor[cell]] = b
                            cursor[cell] += 1
    return starts, items


@kernel
def slab_interval(origin: float, inverse: float, half: float) -> tuple[float, float]:
    """Ray parameters at which a ray enters and leaves the slab |x| <= half."""
    a = (-half - origin) * inverse
    b = (half - origin) * inverse
    return min(a, b), max(a, b)


@kernel
def hit_box(boxes: Float, b: int, origin: Float, direction: Float) -> tuple[float, int]:
    """Ray parameter (`_FAR` without a hit) and side, 0..5 for xXyYzZ, where a ray from outside enters box b."""
    x, y, z = origin[0] - boxes[b, 0], origin[1] - boxes[b, 1], origin[2] - boxes[b, 2]
    cosine, sine = boxes[b, 6], boxes[b, 7]
    local_x, local_y = cosine * x + sine * y, cosine * y - sine * x
    along_x, along_y = cosine * direction[0] + sine * direction[1], cosine * direction[1] - sine * direction[0]
    along_z = direction[2]
    inverse_x = 1.0 / along_x if along_x != 0.0 else _FAR
    inverse_y = 1.0 / along_y if along_y != 0.0 else _FAR
    inverse_z = 1.0 / along_z if along_z != 0.0 else _FAR
    enter, leave = slab_interval(local_x, inverse_x, boxes[b, 3])
    side = 0 if along_x > 0 else 1
    enter_y, leave_y = slab_interval(local_y, inverse_y, boxes[b, 4])
    if enter_y > enter:
        enter = enter_y
        side = 2 if along_y > 0 else 3
    enter_z, leave_z = slab_interval(z, inverse_z, boxes[b, 5])
    if enter_z > enter:
        enter = enter_z
        side = 4 if along_z > 0 else 5
    leave = min(leave, leave_y, leave_z)
    if enter > leave or enter <= 1e-6:
        return _FAR, -1
    return enter, side


@kernel
def cast_ray(
    grid: BoxGrid, origin: Float, direction: Float, farthest: float, is_any_enough: bool, skipped_box: int
) -> tuple[float, int, int]:
    """Nearest hit (parameter, box, side) up to `farthest`, box -1 without one; any hit if that is enough (shadows).

    Walks the grid cell by cell from an origin inside it. Source: Amanatides and Woo 1987.
    """
    boxes, low, cell_m, counts, starts, items = grid
    cell = np.empty(3, np.int64)
    step = np.empty(3, np.int64)
    crossing = np.empty(3)
    spacing = np.empty(3)
    for axis in range(3):
        cell[axis] = math.floor((origin[axis] - low[axis]) / cell_m)
        if direction[axis] == 0.0:
            step[axis], crossing[axis], spacing[axis] = 0, _FAR, _FAR
            continue
        step[axis] = 1 if direction[axis] > 0 else -1
        edge = cell[axis] + (1 if direction[axis] > 0 else 0)
        crossing[axis] = (low[axis] + edge * cell_m - origin[axis]) / direction[axis]
        spacing[axis] = abs(cell_m / direction[axis])
    nearest = farthest
    box, side = -1, -1
    while 0 <= cell[0] < counts[0] and 0 <= cell[1] < counts[1] and 0 <= cell[2] < counts[2]:
        index = (cell[2] * counts[1] + cell[1]) * counts[0] + cell[0]
        for slot in range(starts[index], starts[index + 1]):
            b = items[slot]
            if b == skipped_box:
                continue
            parameter, entered = hit_box(boxes, b, origin, direction)
            if parameter < nearest:
                nearest, box, side = parameter, b, entered
                if is_any_enough:
                    return nearest, box, side
        axis = 0
        if crossing[1] < crossing[axis]:
            axis = 1
        if crossing[2] < crossing[axis]:
            axis = 2
        if nearest <= crossing[axis] or crossing[axis] > farthest:
            break
        cell[axis] += step[axis]
        crossing[axis] += spacing[axis]
    return nearest, box, side


@kernel
def bake_faces(
    quads: Float,
    numbers: Int32,
    owners: Int32,
    owner_shift: int,
    grid: BoxGrid,
    lamps: Float,
    reach_m: float,
    has_shadows: bool,
    light: NDArray[np.float32],
) -> None:
    """Adds the direct light of `lamps` (L, 5: x y z power group) to the light samples of faces.

    light (groups, samples). The lamp term is 1 / (r^2 + 3), softened because lamps are long; it fades to 0 at reach_m.
    owners' boxes are at owner_shift + their number in the grid's boxes.
    """
    origin = np.empty(3)
    direction = np.empty(3)
    for f in range(quads.shape[0]):
        ux, uy, uz = quads[f, 3], quads[f, 4], quads[f, 5]
        vx, vy, vz = quads[f, 6], quads[f, 7], quads[f, 8]
        nx, ny, nz = vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux
        scale = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        along_u, along_v = numbers[f, 4], numbers[f, 5]
        skipped = owners[f, 0] + owner_shift if owners[f, 0] >= 0 else -1
        for j in range(along_v):
            v = min(max(j / (along_v - 1.0), 0.04), 0.96)
            for i in range(along_u):
                u = min(max(i / (along_u - 1.0), 0.04), 0.96)
                origin[0] = quads[f, 0] + u * ux + v * vx + nx * 0.02
                origin[1] = quads[f, 1] + u * uy + v * vy + ny * 0.02
                origin[2] = quads[f, 2] + u * uz + v * vz + nz * 0.02
                sample = numbers[f, 3] + j * along_u + i
                for lamp in range(lamps.shape[0]):
                    dx, dy, dz = lamps[lamp, 0] - origin[0], lamps[lamp, 1] - origin[1], lamps[lamp, 2] - origin[2]
                    squared = dx * dx + dy * dy + dz * dz
                    if squared > reach_m * reach_m:
                        continue
                    cosine = dx * nx + dy * ny + dz * nz
                    if cosine <= 0.0:
                        continue
                    distance = math.sqrt(squared)
                    cosine /= distance
                    if has_shadows:
                        direction[0], direction[1], direction[2] = dx / distance, dy / distance, dz / distance
                        _, box, _ = cast_ray(grid, origin, direction, distance, True, skipped)
                        if box >= 0:
                            continue
                    fade = 1.0 - squared / (reach_m * reach_m)
                    light[int(lamps[lamp, 4]), sample] += lamps[lamp, 3] * cosine / (squared + 3.0) * fade / math.pi
