"""Inner loops of stereo matching along rectified rows: correlation search, then sub-pixel least squares."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.kernel import kernel


@kernel
def _bilinear(image: NDArray[np.uint8], x: float, y: float) -> float:
    c, r = int(x), int(y)
    a, b = x - c, y - r
    top = (1.0 - a) * image[r, c] + a * image[r, c + 1]
    return float((1.0 - b) * top + b * ((1.0 - a) * image[r + 1, c] + a * image[r + 1, c + 1]))


@kernel
def _correlation(left: NDArray[np.uint8], right: NDArray[np.uint8], xl: int, xr: int, y: int, half: int) -> float:
    """Zero-mean normalised cross correlation of two whole-pixel windows in one row."""
    count = (2 * half + 1) * (2 * half + 1)
    sl, sr, sll, srr, slr = 0.0, 0.0, 0.0, 0.0, 0.0
    for v in range(y - half, y + half + 1):
        for k in range(-half, half + 1):
            a, b = float(left[v, xl + k]), float(right[v, xr + k])
            sl += a
            sr += b
            sll += a * a
            srr += b * b
            slr += a * b
    variance = (sll - sl * sl / count) * (srr - sr * sr / count)
    if variance < 1e-6:
        return -1.0
    return float((slr - sl * sr / count) / np.sqrt(variance))


@kernel
def _refine(
    left: NDArray[np.uint8], right: NDArray[np.uint8], x: float, y: float, disparity: float, half: int, window: Array
) -> tuple[float, float]:
    """Disparity and its standard deviation by Gauss-Newton with a free offset and gain; NaN where it does not settle.

    `window` is scratch of at least (2 half + 1)^2. Source: Lucas and Kanade 1981, along the row alone.
    """
    height, width = right.shape
    count = (2 * half + 1) * (2 * half + 1)
    if x - half < 1 or y - half < 1 or x + half + 2 >= width or y + half + 2 >= height:
        return np.nan, np.nan
    mean = 0.0
    n = 0
    for dv in range(-half, half + 1):
        for du in range(-half, half + 1):
            window[n] = _bilinear(left, x + du, y + dv)
            mean += window[n]
            n += 1
    mean /= count
    energy = 0.0
    for n in range(count):
        window[n] -= mean
        energy += window[n] * window[n]
    if energy < count:
        return np.nan, np.nan
    sigma = np.nan
    for _ in range(12):
        xr = x - disparity
        if xr - half < 2 or xr + half + 3 >= width:
            return np.nan, np.nan
        mean_right, n = 0.0, 0
        for dv in range(-half, half + 1):
            for du in range(-half, half + 1):
                mean_right += _bilinear(right, xr + du, y + dv)
        mean_right /= count
        cross, power = 0.0, 0.0
        n = 0
        for dv in range(-half, half + 1):
            for du in range(-half, half + 1):
                b = _bilinear(right, xr + du, y + dv) - mean_right
                cross += window[n] * b
                power += b * b
                n += 1
        gain = cross / max(power, 1e-9)
        if gain < 0.4 or gain > 2.5:
            return np.nan, np.nan
        jj, jr, rr = 0.0, 0.0, 0.0
        n = 0
        for dv in range(-half, half + 1):
            for du in range(-half, half + 1):
                b = _bilinear(right, xr + du, y + dv) - mean_right
                slope = 0.5 * gain * (_bilinear(right, xr + du + 1, y + dv) - _bilinear(right, xr + du - 1, y + dv))
                r = window[n] - gain * b
                jj += slope * slope
                jr += slope * r
                rr += r * r
                n += 1
        if jj < 10.0 * count:
            return np.nan, np.nan
        step = jr / jj
        disparity -= step
        if abs(step) > 2.0:
            return np.nan, np.nan
        if abs(step) < 0.005:
            if rr > 0.3 * energy:
                return np.nan, np.nan
            sigma = np.sqrt((rr / count + 4.0) / jj)
            break
    return (np.nan, np.nan) if np.isnan(sigma) else (disparity, sigma)


@kernel
def _search(
    left: NDArray[np.uint8], right: NDArray[np.uint8], xl: int, y: int, first: int, last: int, half: int, scores: Array
) -> tuple[int, float, float]:
    """Best whole-pixel disparity in [first, last], its correlation, and the best one that is not its neighbour."""
    height, width = left.shape
    best, best_score = -1, -1.0
    if y < half or y + half >= height or xl < half or xl + half >= width:
        return -1, -1.0, -1.0
    for d in range(first, last + 1):
        scores[d - first] = -1.0
        xr = xl - d
        if xr < half or xr + half >= width:
            continue
        scores[d - first] = _correlation(left, right, xl, xr, y, half)
        if scores[d - first] > best_score:
            best, best_score = d, scores[d - first]
    second = -1.0
    for d in range(first, last + 1):
        if abs(d - best) > 2 and scores[d - first] > second:
            second = scores[d - first]
    return best, best_score, second


@kernel
def match_rows(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    left_half: NDArray[np.uint8],
    right_half: NDArray[np.uint8],
    pixels: Array,
    prior_px: Array,
    max_disparity_px: float,
    min_correlation: float,
    uniqueness: float,
    wide: int,
    narrow: int,
    agreement_px: float,
) -> Array:
    """(N, 2) disparity and its standard deviation, NaN where no trustworthy match is on the row."""
    out = np.full((len(pixels), 2), np.nan)
    scores = np.empty(int(max_disparity_px) + 16)
    window = np.empty((2 * wide + 1) * (2 * wide + 1))
    for n in range(len(pixels)):
        x, y = pixels[n, 0], pixels[n, 1]
        xi, yi = int(x + 0.5), int(y + 0.5)
        if prior_px[n] == prior_px[n]:
            first = max(int(prior_px[n] + 0.5) - 3, 0)
            last = first + 6
        else:
            coarse, score, second = _search(
                left_half, right_half, xi // 2, yi // 2, 0, int(max_disparity_px / 2), 4, scores
            )
            if score < min_correlation or second > uniqueness * score:
                continue
            first, last = max(2 * coarse - 3, 0), 2 * coarse + 3
        whole, score, second = _search(left, right, xi, yi, first, last, wide, scores)
        if score < min_correlation:
            continue
        d_wide, _ = _refine(left, right, x, y, float(whole), wide, window)
        if np.isnan(d_wide):
            continue
        d_narrow, sigma_narrow = _refine(left, right, x, y, d_wide, narrow, window)
        if np.isnan(d_narrow) or abs(d_wide - d_narrow) > agreement_px:
            continue
        out[n, 0] = d_narrow
        out[n, 1] = np.sqrt(sigma_narrow * sigma_narrow + 0.25 * (d_wide - d_narrow) * (d_wide - d_narrow))
    return out
