"""Elimination of landmarks from an adjustment whose calibration is free: the reduced system with a dense border."""

from typing import NamedTuple

import numpy as np

from fleetmap.geometry import AnyArray, Array
from fleetmap.numerics.kernel import kernel


class ImageRows(NamedTuple):
    """Whitened rows of M observations: residuals (M, 4), derivatives by pose (M, 4, 6), point (M, 4, 3) and calibration (M, 4, C)."""

    residuals: Array
    by_keyframe: Array
    by_point: Array
    by_calibration: Array


class BorderedLandmarks(NamedTuple):
    """Of N landmarks: inverse (N, 3, 3) of their information, rhs (N, 3), coupling (N, 3, C) to the calibration."""

    inverse: Array
    rhs: Array
    coupling: Array


@kernel
def reduce_landmarks(
    rows: ImageRows,
    keyframes: AnyArray,
    starts: AnyArray,
    layout: tuple[int, float],
    system: tuple[Array, Array],
    out: BorderedLandmarks,
) -> None:
    """Adds what images say of poses and calibration to system: information (D, D), its upper triangle of blocks, and rhs (D,).

    starts (N + 1,): first observation of each landmark, rising. layout: unknowns per keyframe, and the damping of landmarks.
    """
    _, by_keyframe, by_point, by_calibration = rows
    (stride, damping), (info, rhs), (inverse, _, coupling) = layout, system, out
    size = by_calibration.shape[2]
    first_c = info.shape[0] - size
    most = 0
    for n in range(len(starts) - 1):
        most = max(most, starts[n + 1] - starts[n])
    keyframe_point, block, corner = np.empty((most, 6, 3)), np.empty((3, 3)), np.zeros((size, size))
    for n in range(len(starts) - 1):
        begin, end = starts[n], starts[n + 1]
        count = end - begin
        border = coupling[n]
        block[:], border[:] = 0.0, 0.0
        for m in range(count):
            row = begin + m
            at = keyframes[row] * stride
            point, turn, cal = by_point[row], by_keyframe[row], by_calibration[row]
            for a in range(3):
                p0, p1, p2, p3 = point[0, a], point[1, a], point[2, a], point[3, a]
                for b in range(3):
                    value = block[a, b] + p0 * point[0, b] + p1 * point[1, b]
                    block[a, b] = value + p2 * point[2, b] + p3 * point[3, b]
                for c in range(size):
                    value = border[a, c] + p0 * cal[0, c] + p1 * cal[1, c]
                    border[a, c] = value + p2 * cal[2, c] + p3 * cal[3, c]
            for a in range(6):
                t0, t1, t2, t3 = turn[0, a], turn[1, a], turn[2, a], turn[3, a]
                for b in range(3):
                    value = t0 * point[0, b] + t1 * point[1, b]
                    keyframe_point[m, a, b] = value + t2 * point[2, b] + t3 * point[3, b]
                for b in range(6):
                    value = info[at + a, at + b] + t0 * turn[0, b] + t1 * turn[1, b]
                    info[at + a, at + b] = value + t2 * turn[2, b] + t3 * turn[3, b]
                for c in range(size):
                    value = info[at + a, first_c + c] + t0 * cal[0, c] + t1 * cal[1, c]
                    info[at + a, first_c + c] = value + t2 * cal[2, c] + t3 * cal[3, c]
            for a in range(size):
                c0, c1, c2, c3 = cal[0, a], cal[1, a], cal[2, a], cal[3, a]
                for b in range(size):
                    corner[a, b] = corner[a, b] + c0 * cal[0, b] + c1 * cal[1, b] + c2 * cal[2, b] + c3 * cal[3, b]
        trace = block[0, 0] + block[1, 1] + block[2, 2]
        for a in range(3):
            block[a, a] += damping * block[a, a] + 1e-9 * trace + 1e-12
        held = np.linalg.inv(block)
        inverse[n] = held
        lifted = held @ border
        for a in range(size):
            b0, b1, b2 = border[0, a], border[1, a], border[2, a]
            for b in range(size):
                corner[a, b] = corner[a, b] - b0 * lifted[0, b] - b1 * lifted[1, b] - b2 * lifted[2, b]
        for m in range(count):
            at = keyframes[begin + m] * stride
            turned = keyframe_point[m] @ held
            for a in range(6):
                k0, k1, k2 = keyframe_point[m, a, 0], keyframe_point[m, a, 1], keyframe_point[m, a, 2]
                for c in range(size):
                    value = info[at + a, first_c + c] - k0 * lifted[0, c] - k1 * lifted[1, c]
                    info[at + a, first_c + c] = value - k2 * lifted[2, c]
            for other in range(m, count):
                to = keyframes[begin + other] * stride
                lower = to < at
                for a in range(6):
                    for b in range(6):
                        value = 0.0
                        for d in range(3):
                            value += turned[a, d] * keyframe_point[other, b, d]
                        if lower:
                            info[to + b, at + a] -= value
                        else:
                            info[at + a, to + b] -= value
    info[first_c:, first_c:] += corner
    reduce_residuals(rows, keyframes, starts, stride, rhs, out)


@kernel
def reduce_residuals(
    rows: ImageRows, keyframes: AnyArray, starts: AnyArray, stride: int, rhs: Array, out: BorderedLandmarks
) -> None:
    """The part of `reduce_landmarks` that residuals change: rhs (D,), and that of the landmarks in `out`, which holds the rest."""
    residuals, by_keyframe, by_point, by_calibration = rows
    inverse, point_rhs, coupling = out
    size = by_calibration.shape[2]
    first_c = len(rhs) - size
    for n in range(len(starts) - 1):
        slope = point_rhs[n]
        slope[:] = 0.0
        for row in range(starts[n], starts[n + 1]):
            at = keyframes[row] * stride
            for e in range(4):
                value = residuals[row, e]
                for a in range(3):
                    slope[a] -= by_point[row, e, a] * value
                for a in range(6):
                    rhs[at + a] -= by_keyframe[row, e, a] * value
                for a in range(size):
                    rhs[first_c + a] -= by_calibration[row, e, a] * value
        pulled = np.asfortranarray(inverse[n]) @ slope
        for a in range(size):
            for d in range(3):
                rhs[first_c + a] -= coupling[n, d, a] * pulled[d]
        for row in range(starts[n], starts[n + 1]):
            at = keyframes[row] * stride
            for a in range(6):
                for d in range(3):
                    coupled = 0.0
                    for e in range(4):
                        coupled += by_keyframe[row, e, a] * by_point[row, e, d]
                    rhs[at + a] -= coupled * pulled[d]


@kernel
def landmark_steps(
    rows: ImageRows,
    keyframes: AnyArray,
    starts: AnyArray,
    eliminated: BorderedLandmarks,
    steps: tuple[Array, Array],
    moved: Array,
) -> None:
    """Back-substitution: moved (N, 3) for steps of the poses (K, >= 6) and of the calibration (C,)."""
    inverse, point_rhs, coupling = eliminated
    of_keyframes, calibration = steps
    for n in range(len(starts) - 1):
        slope = point_rhs[n] - coupling[n] @ calibration
        for row in range(starts[n], starts[n + 1]):
            step = of_keyframes[keyframes[row]]
            for e in range(4):
                value = 0.0
                for a in range(6):
                    value += rows.by_keyframe[row, e, a] * step[a]
                for a in range(3):
                    slope[a] -= rows.by_point[row, e, a] * value
        moved[n] = inverse[n] @ slope


@kernel
def weigh(slopes: Array, factors: Array) -> None:
    """Multiplies derivatives (M, 4, n) by factors (M, 4) in place; NaN counts as zero, and what is infinite as the largest number."""
    largest = np.finfo(np.float64).max
    for m in range(slopes.shape[0]):
        for e in range(slopes.shape[1]):
            factor = factors[m, e]
            for a in range(slopes.shape[2]):
                value = slopes[m, e, a]
                if np.isnan(value):
                    value = 0.0
                slopes[m, e, a] = min(max(value, -largest), largest) * factor
