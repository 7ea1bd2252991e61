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
    residuals, by_keyframe, by_point, by_calibration = rows
    (stride, damping), (info, rhs), (inverse, point_rhs, coupling) = layout, system, out
    size = by_calibration.shape[2]
    first_c = info.shape[0] - size
    for n in range(len(starts) - 1):
        begin, end = starts[n], starts[n + 1]
        count = end - begin
        block, slope, border = np.zeros((3, 3)), np.zeros(3), np.zeros((3, size))
        keyframe_point = np.zeros((count, 6, 3))
        for m in range(count):
            row = begin + m
            at = keyframes[row] * stride
            for e in range(4):
                value = residuals[row, e]
                point, turn, cal = by_point[row, e], by_keyframe[row, e], by_calibration[row, e]
                for a in range(3):
                    slope[a] -= point[a] * value
                    for b in range(3):
                        block[a, b] += point[a] * point[b]
                    for c in range(size):
                        border[a, c] += point[a] * cal[c]
                    for b in range(6):
                        keyframe_point[m, b, a] += turn[b] * point[a]
                for a in range(6):
                    rhs[at + a] -= turn[a] * value
                    for b in range(6):
                        info[at + a, at + b] += turn[a] * turn[b]
                    for c in range(size):
                        info[at + a, first_c + c] += turn[a] * cal[c]
                for a in range(size):
                    rhs[first_c + a] -= cal[a] * value
                    for b in range(size):
                        info[first_c + a, first_c + b] += cal[a] * cal[b]
        trace = block[0, 0] + block[1, 1] + block[2, 2]
        for a in range(3):
            block[a, a] += damping * block[a, a] + 1e-9 * trace + 1e-12
        held = np.linalg.inv(block)
        inverse[n], point_rhs[n], coupling[n] = held, slope, border
        lifted = held @ border
        pulled = held @ slope
        for a in range(size):
            for d in range(3):
                rhs[first_c + a] -= border[d, a] * pulled[d]
                for b in range(size):
                    info[first_c + a, first_c + b] -= border[d, a] * lifted[d, b]
        for m in range(count):
            at = keyframes[begin + m] * stride
            turned = keyframe_point[m] @ held
            for a in range(6):
                for d in range(3):
                    rhs[at + a] -= keyframe_point[m, a, d] * pulled[d]
                    for c in range(size):
                        info[at + a, first_c + c] -= keyframe_point[m, a, d] * lifted[d, c]
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
