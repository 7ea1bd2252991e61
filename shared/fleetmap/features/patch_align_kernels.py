"""Inner loop of patch alignment: where exactly a small window of one picture lies in another."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.kernel import kernel


@kernel
def _sample(image: NDArray[np.uint8], x: float, y: float) -> float:
    c, r = int(x), int(y)
    a, b = x - c, y - r
    top = (1.0 - a) * image[r, c] + a * image[r, c + 1]
    return float((1.0 - b) * top + b * ((1.0 - a) * image[r + 1, c] + a * image[r + 1, c + 1]))


@kernel
def align_patches(
    reference: NDArray[np.uint8], current: NDArray[np.uint8], reference_pixels: Array, current_pixels: Array,
    reference_from_current: Array, half: int, max_shift_px: float, out: Array,
) -> None:  # fmt: skip
    """Moves each current pixel until the reference's window, warped, lies on it.

    reference_from_current (N, 2, 2) maps offsets in the current picture to offsets in the reference. out (N, 4): x, y,
    sigma_px (from the residual and the window's gradients, the weaker direction), correlation; NaN where alignment
    fails or leaves max_shift_px. Inverse compositional translation with free offset and gain. Source: Baker and
    Matthews 2004.
    """
    side = 2 * half + 1
    count = side * side
    height, width = current.shape
    ref_height, ref_width = reference.shape
    template = np.empty((side + 2, side + 2))
    window = np.empty(count)
    for n in range(len(reference_pixels)):
        out[n, 0] = out[n, 1] = out[n, 2] = out[n, 3] = np.nan
        a = reference_from_current[n]
        reach = (half + 1) * max(abs(a[0, 0]) + abs(a[0, 1]), abs(a[1, 0]) + abs(a[1, 1])) + 1
        rx, ry = reference_pixels[n, 0], reference_pixels[n, 1]
        if not (reach < rx < ref_width - reach - 2 and reach < ry < ref_height - reach - 2):
            continue
        for v in range(side + 2):
            for u in range(side + 2):
                du, dv = u - half - 1.0, v - half - 1.0
                template[v, u] = _sample(reference, rx + a[0, 0] * du + a[0, 1] * dv, ry + a[1, 0] * du + a[1, 1] * dv)
        mean = 0.0
        for v in range(1, side + 1):
            for u in range(1, side + 1):
                mean += template[v, u]
        mean /= count
        xx, xy, yy, energy = 0.0, 0.0, 0.0, 0.0
        for v in range(1, side + 1):
            for u in range(1, side + 1):
                gx, gy = (
                    0.5 * (template[v, u + 1] - template[v, u - 1]),
                    0.5 * (template[v + 1, u] - template[v - 1, u]),
                )
                xx += gx * gx
                xy += gx * gy
                yy += gy * gy
                energy += (template[v, u] - mean) ** 2
        det = xx * yy - xy * xy
        trace = xx + yy
        weak = 0.5 * trace - np.sqrt(max(0.25 * trace * trace - det, 0.0))
        if weak < 5.0 * count or energy < 1.0:
            continue
        x, y = current_pixels[n, 0], current_pixels[n, 1]
        for _ in range(15):
            if not (half + 1 < x < width - half - 3 and half + 1 < y < height - half - 3):
                break
            total, k = 0.0, 0
            for v in range(side):
                for u in range(side):
                    window[k] = _sample(current, x + u - half, y + v - half)
                    total += window[k]
                    k += 1
            total /= count
            cross, power, k = 0.0, 0.0, 0
            for v in range(side):
                for u in range(side):
                    b = window[k] - total
                    cross += b * (template[v + 1, u + 1] - mean)
                    power += b * b
                    k += 1
            if power < 1.0 or cross <= 0.0:
                break
            gain = cross / power
            bx, by, rr, k = 0.0, 0.0, 0.0, 0
            for v in range(side):
                for u in range(side):
                    r = gain * (window[k] - total) - (template[v + 1, u + 1] - mean)
                    bx += 0.5 * (template[v + 1, u + 2] - template[v + 1, u]) * r
                    by += 0.5 * (template[v + 2, u + 1] - template[v, u + 1]) * r
                    rr += r * r
                    k += 1
            sx, sy = (yy * bx - xy * by) / det, (xx * by - xy * bx) / det
            x -= sx
            y -= sy
            if abs(x - current_pixels[n, 0]) > max_shift_px or abs(y - current_pixels[n, 1]) > max_shift_px:
                break
            if sx * sx + sy * sy < 1e-4:
                out[n, 0], out[n, 1] = x, y
                out[n, 2] = np.sqrt((rr / count + 4.0) / weak)
                out[n, 3] = cross / np.sqrt(power * energy)
                break
