"""Inner loops of corner selection and orientation."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

HALF_WINDOW = 3


def _gradient_sums_at(typing_context: Any, pixel: Any, row_bytes: Any) -> Any:
    """Sums of xx, xy, yy of the gradients in the window around the pixel at an address: a row of eight pixels at once, less the last."""
    return cast(Any, types).UniTuple(types.int64, 3)(types.int64, types.int64), _emit_gradient_sums


def _emit_gradient_sums(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    pixel, row_bytes = arguments
    narrow, word = ir.VectorType(ir.IntType(8), 8), ir.IntType(64)
    lane, counted = ir.VectorType(ir.IntType(32), 8), ir.VectorType(ir.IntType(32), 8)([-1] * 7 + [0])

    def grey(u: int, v: int) -> Any:
        at = builder.add(builder.add(pixel, builder.mul(row_bytes, word(v))), word(u))
        return builder.zext(builder.load(builder.inttoptr(at, narrow.as_pointer()), align=1), lane)

    rows = range(-HALF_WINDOW, HALF_WINDOW + 1)
    centres = {v: grey(-HALF_WINDOW, v) for v in range(-HALF_WINDOW - 1, HALF_WINDOW + 2)}
    along = [builder.sub(grey(1 - HALF_WINDOW, v), grey(-1 - HALF_WINDOW, v)) for v in rows]
    down = [builder.sub(centres[v + 1], centres[v - 1]) for v in rows]
    sums = []
    for one, other in ((along, along), (along, down), (down, down)):
        total = lane(None)
        for a, b in zip(one, other, strict=True):
            total = builder.add(total, builder.mul(a, b))
        total = builder.and_(total, counted)
        for step in (4, 2, 1):
            order = ir.VectorType(ir.IntType(32), 8)([(k + step) % 8 for k in range(8)])
            total = builder.add(total, builder.shuffle_vector(total, lane(ir.Undefined), order))
        sums.append(builder.sext(builder.extract_element(total, ir.IntType(32)(0)), word))
    return context.make_tuple(builder, signature.return_type, sums)


_gradient_sums = cast(Callable[..., tuple[int, int, int]], intrinsic(_gradient_sums_at))


@kernel
def min_eigenvalue_scores(image: NDArray[np.uint8], pixels: NDArray[np.float32]) -> Array:
    """(N,) smaller eigenvalue of the gradient matrix in a window of HALF_WINDOW. Source: Shi and Tomasi 1994."""
    height, width = image.shape
    scores, rim = np.zeros(len(pixels)), HALF_WINDOW + 1
    image_at, row_bytes = np.int64(image.ctypes.data), np.int64(image.strides[0])
    for n in range(len(pixels)):
        x, y = int(pixels[n, 0]), int(pixels[n, 1])
        if x < rim or y < rim or x >= width - rim or y >= height - rim:
            continue  # of the eighth pixel of a row the window's last row but one still has a next row behind it
        xx, xy, yy = _gradient_sums(image_at + y * row_bytes + x, row_bytes)
        mean = 0.5 * (xx + yy)
        scores[n] = mean - np.sqrt(max(mean * mean - (float(xx) * float(yy) - float(xy) * float(xy)), 0.0))
    return scores


@kernel
def select_spread(
    pixels: NDArray[np.float32],
    order: NDArray[np.int64],
    taken: NDArray[np.float32],
    cell_px: float,
    count: int,
    width: int,
    height: int,
) -> NDArray[np.int64]:
    """Indices of up to `count` pixels, best first as `order` says, no two within `cell_px` of each other or of `taken`.

    Greedy suppression on a grid of cells, each with a chain of what it holds.
    """
    columns, rows = int(width / cell_px) + 1, int(height / cell_px) + 1
    newest = np.full((rows, columns), -1, np.int64)
    earlier = np.full(len(taken) + count, -1, np.int64)
    places = np.empty((len(taken) + count, 2))
    held = 0
    for n in range(len(taken)):
        c, r = int(np.floor(taken[n, 0] / cell_px)), int(np.floor(taken[n, 1] / cell_px))
        if 0 <= c < columns and 0 <= r < rows:
            places[held, 0], places[held, 1] = taken[n, 0], taken[n, 1]
            earlier[held], newest[r, c] = newest[r, c], held
            held += 1
    chosen = np.empty(count, np.int64)
    found = 0
    for k in range(len(order)):
        if found == count:
            break
        x, y = pixels[order[k], 0], pixels[order[k], 1]
        c, r = int(x / cell_px), int(y / cell_px)
        free = True
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for cc in range(max(c - 1, 0), min(c + 2, columns)):
                other = newest[rr, cc]
                while free and other >= 0:
                    dx, dy = places[other, 0] - x, places[other, 1] - y
                    free = dx * dx + dy * dy >= cell_px * cell_px
                    other = earlier[other]
        if free:
            places[held, 0], places[held, 1] = x, y
            earlier[held], newest[r, c] = newest[r, c], held
            held += 1
            chosen[found] = order[k]
            found += 1
    return chosen[:found]


@kernel
def clear_discs(free: NDArray[np.uint8], taken: NDArray[np.float32], radius_px: float) -> None:
    """Sets pixels nearer than radius_px to one of `taken` (M, 2) in the image to 0, a ring of up to 1.5 px at the edge left out."""
    height, width = free.shape
    reach = radius_px - 0.75  # from the nearest whole pixel
    size = int(reach)
    for n in range(len(taken)):
        x, y = int(np.floor(taken[n, 0] + 0.5)), int(np.floor(taken[n, 1] + 0.5))
        if x < 0 or y < 0 or x >= width or y >= height:
            continue
        for dv in range(-min(size, y), min(size, height - 1 - y) + 1):
            half = int(np.sqrt(reach * reach - dv * dv))
            free[y + dv, max(x - half, 0) : min(x + half + 1, width)] = 0


@kernel
def centroid_angles_deg(image: NDArray[np.uint8], pixels: NDArray[np.float32], radius: int) -> NDArray[np.float32]:
    """(N,) direction in degrees [0, 360) from each pixel to the intensity centroid of its disc.

    Source: Rosin 1999, as ORB uses it.
    """
    angles = np.zeros(len(pixels), np.float32)
    height, width = image.shape
    reach = np.empty(radius + 1, np.int64)
    for dv in range(radius + 1):
        reach[dv] = int(np.sqrt(radius * radius - dv * dv))
    for n in range(len(pixels)):
        x, y = int(pixels[n, 0] + 0.5), int(pixels[n, 1] + 0.5)
        m10, m01 = np.int64(0), np.int64(0)
        if x >= radius and y >= radius and x < width - radius and y < height - radius:
            disc = image[y - radius : y + radius + 1, x - radius : x + radius + 1]
            for v in range(2 * radius + 1):
                r = reach[abs(v - radius)]
                row = disc[v, radius - r : radius + r + 1]
                along, total = np.int64(0), np.int64(0)
                for u in range(2 * r + 1):
                    value = np.int64(row[u])
                    along += u * value
                    total += value
                m10 += along - r * total
                m01 += (v - radius) * total
        else:
            for dv in range(-radius, radius + 1):
                v, r = min(max(y + dv, 0), height - 1), reach[abs(dv)]
                for du in range(-r, r + 1):
                    value = np.int64(image[v, min(max(x + du, 0), width - 1)])
                    m10 += du * value
                    m01 += dv * value
        angles[n] = np.degrees(np.arctan2(float(m01), float(m10))) % 360.0
    return angles
