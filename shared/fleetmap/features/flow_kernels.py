"""Inner loops of optical flow: small windows followed from image to image.

Windows are kept as one row of numbers: their right and lower neighbours are the same row begun elsewhere, and whole registers do
the work. Columns beyond a window are multiplied by slopes of 0. Sums are folded in halves, in the same order on every processor.
"""

import math

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel

Grey = NDArray[np.uint8]
Window = NDArray[np.float32]

MOST_HALF = 7
_ROW, _WIDE_ROW = 16, 24  # numbers in a row of a window, and of one that is larger by a pixel on all sides
_FOLDED = 256  # no less than a window has, a power of two
_LEAST_SLOPE = 0.1  # mean square per pixel, in grey values, along the direction in which a window shows least
_TURNING_PX = 0.01  # two steps that undo each other up to this: between them lies the end


@inner_kernel
def _cut(image: Grey, x: int, y: int, rows: int, columns: int, cells: Window) -> None:
    """Fills rows of cells with whole pixels, the first at (x, y); beyond its edges the image is mirrored."""
    height, width = image.shape
    if x >= 0 and y >= 0 and x + columns <= width and y + rows <= height:
        for v in range(rows):
            row, out = image[y + v, x : x + columns], cells[v * columns : (v + 1) * columns]
            for u in range(columns):
                out[u] = row[u]
        return
    for v in range(rows):
        line = abs(y + v)
        line = min(max(2 * (height - 1) - line if line >= height else line, 0), height - 1)
        for u in range(columns):
            at = abs(x + u)
            at = min(max(2 * (width - 1) - at if at >= width else at, 0), width - 1)
            cells[v * columns + u] = image[line, at]


@inner_kernel
def _mix(cells: Window, columns: int, a: float, b: float, count: int, out: Window) -> None:
    """out[k], k < count: between cell k, its right neighbour and the two below, by shares a and b."""
    one, right, down = np.float32(1.0), np.float32(a), np.float32(b)
    w00, w01, w10, w11 = (one - right) * (one - down), right * (one - down), (one - right) * down, right * down
    c01, c10, c11 = cells[1:], cells[columns:], cells[columns + 1 :]
    for k in range(count):
        out[k] = w00 * cells[k] + w01 * c01[k] + w10 * c10[k] + w11 * c11[k]


@inner_kernel
def _sum(terms: Window) -> float:
    """Sum of terms (_FOLDED,), whose first half is lost."""
    half = _FOLDED // 2
    while half >= 32:
        upper = terms[half:]
        for k in range(half):
            terms[k] += upper[k]
        half //= 2
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    for k in range(0, 32, 4):
        a, b, c, d = a + terms[k], b + terms[k + 1], c + terms[k + 2], d + terms[k + 3]
    return (a + b) + (c + d)


@inner_kernel
def _template(
    image: Grey, x: float, y: float, half: int, cells: Window, wide: Window, grey: Window, right: Window, down: Window
) -> None:
    """Fills grey values and slopes to the right and downwards of the window around (x, y). Slopes outside the image are 0.

    Source of the filter: Scharr 2000.
    """
    height, width = image.shape
    size = 2 * half + 1
    left, top = math.floor(x) - half, math.floor(y) - half
    _cut(image, left - 1, top - 1, size + 3, _WIDE_ROW, cells)
    _mix(cells, _WIDE_ROW, x - math.floor(x), y - math.floor(y), (size + 2) * _WIDE_ROW, wide)
    three, ten = np.float32(3.0 / 32.0), np.float32(10.0 / 32.0)
    for v in range(size):
        above, here, below = wide[v * _WIDE_ROW :], wide[(v + 1) * _WIDE_ROW :], wide[(v + 2) * _WIDE_ROW :]
        row = slice(v * _ROW, v * _ROW + size)
        grey_row, right_row, down_row = grey[row], right[row], down[row]
        for u in range(size):
            grey_row[u] = here[u + 1]
            right_row[u] = three * (above[u + 2] - above[u] + below[u + 2] - below[u]) + ten * (here[u + 2] - here[u])
            down_row[u] = three * (below[u] - above[u] + below[u + 2] - above[u + 2]) + ten * (
                below[u + 1] - above[u + 1]
            )
    if left < 0 or top < 0 or left + size > width or top + size > height:
        for v in range(size):
            for u in range(size):
                if not (0 <= left + u < width and 0 <= top + v < height):
                    right[v * _ROW + u], down[v * _ROW + u] = np.float32(0.0), np.float32(0.0)


@inner_kernel
def _product(a: Window, b: Window, count: int, terms: Window) -> float:
    for k in range(count):
        terms[k] = a[k] * b[k]
    return _sum(terms)


@inner_kernel
def _find(
    image: Grey,
    grey: Window,
    right: Window,
    down: Window,
    xx: float,
    xy: float,
    yy: float,
    x: float,
    y: float,
    half: int,
    steps: int,
    settled_px: float,
    cells: Window,
    off: Window,
    terms: Window,
) -> tuple[float, float, bool]:
    """Where around (x, y) the window of `_template` is, and whether it stayed in reach of the image on the way there."""
    height, width = image.shape
    count = (2 * half + 1) * _ROW
    scale = 1.0 / (xx * yy - xy * xy)
    held_x, held_y = -(1 << 40), 0
    last_x, last_y = math.inf, math.inf
    for _ in range(steps):
        if not (-half <= x < width + half and -half <= y < height + half):
            return x, y, False
        column, row = math.floor(x), math.floor(y)
        if column != held_x or row != held_y:
            _cut(image, column - half, row - half, 2 * half + 2, _ROW, cells)
            held_x, held_y = column, row
        _mix(cells, _ROW, x - column, y - row, count, off)
        for k in range(count):
            off[k] -= grey[k]
        bx, by = _product(off, right, count, terms), _product(off, down, count, terms)
        step_x, step_y = (xy * by - yy * bx) * scale, (xy * bx - xx * by) * scale
        x, y = x + step_x, y + step_y
        if step_x * step_x + step_y * step_y <= settled_px * settled_px:
            break
        if abs(step_x + last_x) < _TURNING_PX and abs(step_y + last_y) < _TURNING_PX:
            x, y = x - 0.5 * step_x, y - 0.5 * step_y
            break
        last_x, last_y = step_x, step_y
    return x, y, True


@kernel
def follow(
    before: Grey,
    now: Grey,
    scale: float,
    half: int,
    steps: int,
    settled_px: float,
    pixels: Array,
    places: Array,
    found: NDArray[np.bool_],
) -> None:
    """Moves places (N, 2), where windows of 2 half + 1 pixels around pixels (N, 2) of one image are thought to be in the other.

    Both images are `scale` times as large as those that the coordinates are for. half: MOST_HALF at most. found (N,): others
    are left alone, and those without texture, or that leave the image, are no longer. Source: Lucas and Kanade 1981, with the
    slopes of the window that is looked for as in Baker and Matthews 2004.
    """
    assert half <= MOST_HALF
    size = 2 * half + 1
    count = size * _ROW
    cells, wide = np.zeros((_ROW + 2) * _WIDE_ROW + 2, np.float32), np.zeros((_ROW + 2) * _WIDE_ROW + 2, np.float32)
    grey, off = np.zeros(_FOLDED, np.float32), np.zeros(_FOLDED, np.float32)
    right, down, terms = np.zeros(_FOLDED, np.float32), np.zeros(_FOLDED, np.float32), np.zeros(_FOLDED, np.float32)
    for n in range(len(pixels)):
        if not found[n]:
            continue
        _template(before, pixels[n, 0] * scale, pixels[n, 1] * scale, half, cells, wide, grey, right, down)
        xx, xy = _product(right, right, count, terms), _product(right, down, count, terms)
        yy = _product(down, down, count, terms)
        least = 0.5 * (xx + yy - math.sqrt((xx - yy) * (xx - yy) + 4.0 * xy * xy))
        if not least >= _LEAST_SLOPE * size * size:
            found[n] = False
            continue
        start_x, start_y = places[n, 0] * scale, places[n, 1] * scale
        x, y, found[n] = _find(
            now, grey, right, down, xx, xy, yy, start_x, start_y, half, steps, settled_px, cells, off, terms
        )
        if found[n]:
            places[n, 0], places[n, 1] = x / scale, y / scale


@kernel
def check_back(
    before: Grey,
    now: Grey,
    half: int,
    steps: int,
    settled_px: float,
    pixels: Array,
    places: Array,
    within_px: float,
    margin_px: float,
    held: NDArray[np.bool_],
) -> None:
    """Of places (N, 2) that pixels (N, 2) were followed to, and that are held (N,), leaves those inside that lead back.

    Other arguments as of `follow`.
    """
    height, width = now.shape
    for n in range(len(places)):
        x, y = places[n, 0], places[n, 1]
        is_inside = x > margin_px and y > margin_px and x < width - 1 - margin_px and y < height - 1 - margin_px
        held[n] = held[n] and is_inside
    back = pixels.copy()
    follow(now, before, 1.0, half, steps, settled_px, places, back, held)
    for n in range(len(places)):
        off_x, off_y = back[n, 0] - pixels[n, 0], back[n, 1] - pixels[n, 1]
        held[n] = held[n] and off_x * off_x + off_y * off_y < within_px * within_px
