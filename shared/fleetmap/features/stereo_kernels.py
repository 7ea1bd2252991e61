"""Inner loops of stereo matching along rectified rows: correlation search, then sub-pixel least squares."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel


@kernel
def _sample(image: NDArray[np.uint8], x: float, y: float, half: int, rim: int, window: Array) -> None:
    """Fills window with the (2 half + 1) rows of (2 (half + rim) + 1) pixels around (x, y), bilinear; all must lie inside.

    Pixels of one window are whole steps apart, so that the four weights are the same for all of them.
    """
    c, r = int(x), int(y)
    a, b = x - c, y - r
    w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    columns = 2 * (half + rim) + 1
    first = c - half - rim
    for dv in range(2 * half + 1):
        upper, lower, out = image[r - half + dv], image[r - half + dv + 1], window[dv * columns : (dv + 1) * columns]
        for k in range(columns):
            out[k] = (
                w00 * upper[first + k]
                + w01 * upper[first + k + 1]
                + w10 * lower[first + k]
                + w11 * lower[first + k + 1]
            )


@kernel
def _refine(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    x: float,
    y: float,
    disparity: float,
    half: int,
    window: Array,
    strip: Array,
) -> tuple[float, float]:
    """Disparity and its standard deviation by Gauss-Newton with a free offset and gain; NaN where it does not settle.

    `window` is scratch of at least (2 half + 1)^2, `strip` of (2 half + 1) (2 half + 3). Source: Lucas and Kanade 1981, along the
    row alone.
    """
    height, width = right.shape
    size = 2 * half + 1
    count = size * size
    if x - half < 1 or y - half < 1 or x + half + 2 >= width or y + half + 2 >= height:
        return np.nan, np.nan
    _sample(left, x, y, half, 0, window)
    mean = 0.0
    for n in range(count):
        mean += window[n]
    mean /= count
    energy = 0.0
    for n in range(count):
        window[n] -= mean
        energy += window[n] * window[n]
    if energy < count:
        return np.nan, np.nan
    for _ in range(12):
        xr = x - disparity
        if xr - half < 2 or xr + half + 3 >= width:
            return np.nan, np.nan
        _sample(right, xr, y, half, 1, strip)
        total, power, cross = 0.0, 0.0, 0.0
        for row in range(size):
            ours, theirs = window[row * size : (row + 1) * size], strip[row * (size + 2) : (row + 1) * (size + 2)]
            for k in range(size):
                value = theirs[k + 1]
                total += value
                power += value * value
                cross += ours[k] * value  # `ours` has no mean, so that theirs does not count
        mean_right = total / count
        gain = cross / max(power - total * mean_right, 1e-9)
        if gain < 0.4 or gain > 2.5:
            return np.nan, np.nan
        jj, jr, rr = 0.0, 0.0, 0.0
        for row in range(size):
            ours, theirs = window[row * size : (row + 1) * size], strip[row * (size + 2) : (row + 1) * (size + 2)]
            for k in range(size):
                slope = 0.5 * gain * (theirs[k + 2] - theirs[k])
                r = ours[k] - gain * (theirs[k + 1] - mean_right)
                jj += slope * slope
                jr += slope * r
                rr += r * r
        if jj < 10.0 * count:
            return np.nan, np.nan
        step = jr / jj
        disparity -= step
        if abs(step) > 2.0:
            return np.nan, np.nan
        if abs(step) < 0.005:
            return (np.nan, np.nan) if rr > 0.3 * energy else (disparity, np.sqrt((rr / count + 4.0) / jj))
    return np.nan, np.nan


@kernel
def _correlate(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    xl: int,
    y: int,
    x_first: int,
    count: int,
    half: int,
    scores: Array,
    cross: NDArray[np.int32],
    sums: NDArray[np.int32],
) -> None:
    """scores[:count]: zero-mean normalised cross correlation of the left window with those at x_first, x_first + 1, ...

    All windows must lie inside. cross (C,) and sums (2, C) are scratch, C >= count + 2 half. Whole numbers, all columns of a row at
    once: that is what processors do fast.
    """
    size = 2 * half + 1
    area, columns = size * size, count + 2 * half
    cross[:count] = 0
    sums[:, :columns] = 0
    sl, sll = 0, 0
    plain, squared = sums[0], sums[1]
    for v in range(y - half, y + half + 1):
        row = right[v, x_first - half : x_first - half + columns]
        for k in range(columns):
            value = np.int32(row[k])
            plain[k] += value
            squared[k] += value * value
        for k in range(size):
            a = np.int32(left[v, xl - half + k])
            sl += int(a)
            sll += int(a) * int(a)
            part = row[k : k + count]
            for n in range(count):
                cross[n] += a * np.int32(part[n])
    spread = sll - sl * sl / area
    sr, srr = 0, 0
    for k in range(size - 1):
        sr += plain[k]
        srr += squared[k]
    for n in range(count):
        sr += plain[n + size - 1]
        srr += squared[n + size - 1]
        variance = spread * (srr - sr * sr / area)
        scores[n] = -1.0 if variance < 1e-6 else (cross[n] - sl * sr / area) / np.sqrt(variance)
        sr -= plain[n]
        srr -= squared[n]


@kernel
def _search(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    xl: int,
    y: int,
    first: int,
    last: int,
    half: int,
    scores: Array,
    cross: NDArray[np.int32],
    sums: NDArray[np.int32],
) -> tuple[int, float, float]:
    """Best whole-pixel disparity in [first, last], its correlation, and the best one that is not its neighbour."""
    height, width = left.shape
    if y < half or y + half >= height or xl < half or xl + half >= width:
        return -1, -1.0, -1.0
    x_first, x_last = max(xl - last, half), min(xl - first, width - 1 - half)
    count = x_last - x_first + 1
    if count <= 0:
        return -1, -1.0, -1.0
    _correlate(left, right, xl, y, x_first, count, half, scores, cross, sums)
    best, best_score, second = -1, -1.0, -1.0
    for n in range(count - 1, -1, -1):
        if scores[n] > best_score:
            best, best_score = n, scores[n]
    for n in range(count):
        if abs(n - best) > 2 and scores[n] > second:
            second = scores[n]
    return (xl - (x_first + best) if best >= 0 else -1), best_score, second


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
    room = int(max_disparity_px) + 16 + 2 * wide
    scores, cross, sums = np.empty(room), np.empty(room, np.int32), np.empty((2, room), np.int32)
    window, strip = np.empty((2 * wide + 1) * (2 * wide + 1)), np.empty((2 * wide + 1) * (2 * wide + 3))
    for n in range(len(pixels)):
        x, y = pixels[n, 0], pixels[n, 1]
        xi, yi = int(x + 0.5), int(y + 0.5)
        if prior_px[n] == prior_px[n]:
            first = max(int(prior_px[n] + 0.5) - 3, 0)
            last = first + 6
        else:
            coarse, score, second = _search(
                left_half, right_half, xi // 2, yi // 2, 0, int(max_disparity_px / 2), 4, scores, cross, sums
            )
            if score < min_correlation or second > uniqueness * score:
                continue
            first, last = max(2 * coarse - 3, 0), 2 * coarse + 3
        whole, score, second = _search(left, right, xi, yi, first, last, wide, scores, cross, sums)
        if score < min_correlation:
            continue
        d_wide, _ = _refine(left, right, x, y, float(whole), wide, window, strip)
        if np.isnan(d_wide):
            continue
        d_narrow, sigma_narrow = _refine(left, right, x, y, d_wide, narrow, window, strip)
        if np.isnan(d_narrow) or abs(d_wide - d_narrow) > agreement_px:
            continue
        out[n, 0] = d_narrow
        out[n, 1] = np.sqrt(sigma_narrow * sigma_narrow + 0.25 * (d_wide - d_narrow) * (d_wide - d_narrow))
    return out
