"""Inner loop of patch alignment: sub-pixel position of a small window of one image in another."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel


@inner_kernel
def _sample(image: NDArray[np.uint8], x: float, y: float) -> float:
    c, r = int(x), int(y)
    a, b = x - c, y - r
    top = (1.0 - a) * image[r, c] + a * image[r, c + 1]
    return float((1.0 - b) * top + b * ((1.0 - a) * image[r + 1, c] + a * image[r + 1, c + 1]))


@inner_kernel
def _sample_upright(image: NDArray[np.uint8], x: float, y: float, half: int, window: Array) -> float:
    """Fills window (side, side) with the pixels around (x, y) and returns their sum; all must lie inside.

    They are whole steps apart, so that the four weights are the same for all of them.
    """
    c, r = int(x), int(y)
    a, b = x - c, y - r
    w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    side, first = 2 * half + 1, c - half
    total = 0.0
    for v in range(side):
        upper, lower, out = image[r - half + v], image[r - half + v + 1], window[v]
        for u in range(side):
            k = first + u
            out[u] = w00 * upper[k] + w01 * upper[k + 1] + w10 * lower[k] + w11 * lower[k + 1]
        for u in range(side):
            total += out[u]
    return total


@kernel
def align_patch(
    reference: NDArray[np.uint8],
    current: NDArray[np.uint8],
    rx: float,
    ry: float,
    start_x: float,
    start_y: float,
    warp: Array,
    half: int,
    max_shift_px: float,
    template: Array,
    window: Array,
    out: Array,
) -> None:
    """One patch of `align_patches`, out (4,). template (side + 2, side + 2) and window (side, side) are scratch."""
    side = 2 * half + 1
    count = side * side
    height, width = current.shape
    ref_height, ref_width = reference.shape
    out[0] = out[1] = out[2] = out[3] = np.nan
    a00, a01, a10, a11 = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
    reach = (half + 1) * max(abs(a00) + abs(a01), abs(a10) + abs(a11)) + 1
    if not (reach < rx < ref_width - reach - 2 and reach < ry < ref_height - reach - 2):
        return
    for v in range(side + 2):
        dv = v - half - 1.0
        for u in range(side + 2):
            du = u - half - 1.0
            template[v, u] = _sample(reference, rx + a00 * du + a01 * dv, ry + a10 * du + a11 * dv)
    mean = 0.0
    for v in range(1, side + 1):
        for u in range(1, side + 1):
            mean += template[v, u]
    mean /= count
    xx, xy, yy, energy = 0.0, 0.0, 0.0, 0.0
    for v in range(1, side + 1):
        for u in range(1, side + 1):
            gx, gy = 0.5 * (template[v, u + 1] - template[v, u - 1]), 0.5 * (template[v + 1, u] - template[v - 1, u])
            xx += gx * gx
            xy += gx * gy
            yy += gy * gy
            energy += (template[v, u] - mean) ** 2
    det = xx * yy - xy * xy
    trace = xx + yy
    weak = 0.5 * trace - np.sqrt(max(0.25 * trace * trace - det, 0.0))
    if weak < 5.0 * count or energy < 1.0:
        return
    x, y = start_x, start_y
    for _ in range(15):
        if not (half + 1 < x < width - half - 3 and half + 1 < y < height - half - 3):
            return
        total = _sample_upright(current, x, y, half, window) / count
        cross, power = 0.0, 0.0
        for v in range(side):
            for u in range(side):
                b = window[v, u] - total
                cross += b * (template[v + 1, u + 1] - mean)
                power += b * b
        if power < 1.0 or cross <= 0.0:
            return
        gain = cross / power
        bx, by, rr = 0.0, 0.0, 0.0
        for v in range(side):
            for u in range(side):
                r = gain * (window[v, u] - total) - (template[v + 1, u + 1] - mean)
                bx += 0.5 * (template[v + 1, u + 2] - template[v + 1, u]) * r
                by += 0.5 * (template[v + 2, u + 1] - template[v, u + 1]) * r
                rr += r * r
        sx, sy = (yy * bx - xy * by) / det, (xx * by - xy * bx) / det
        x -= sx
        y -= sy
        if abs(x - start_x) > max_shift_px or abs(y - start_y) > max_shift_px:
            return
        if sx * sx + sy * sy < 1e-4:
            out[0], out[1] = x, y
            out[2] = np.sqrt((rr / count + 4.0) / weak)
            out[3] = cross / np.sqrt(power * energy)
            return


@kernel
def align_patches(
    reference: NDArray[np.uint8],
    current: NDArray[np.uint8],
    reference_pixels: Array,
    current_pixels: Array,
    reference_from_current: Array,
    half: int,
    max_shift_px: float,
    out: Array,
) -> None:
    """Moves each current pixel until the reference's window, warped, lies on it.

    reference_from_current (N, 2, 2) maps offsets in the current image to offsets in the reference. out (N, 4): x, y,
    sigma_px (from the residual and the window's gradients, the weaker direction), correlation; NaN where alignment
    fails or leaves max_shift_px. Inverse compositional translation with free offset and gain. Source: Baker and
    Matthews 2004.
    """
    side = 2 * half + 1
    template, window = np.empty((side + 2, side + 2)), np.empty((side, side))
    for n in range(len(reference_pixels)):
        a, b, warp = reference_pixels[n], current_pixels[n], reference_from_current[n]
        align_patch(reference, current, a[0], a[1], b[0], b[1], warp, half, max_shift_px, template, window, out[n])
