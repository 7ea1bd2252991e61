"""Elimination of landmarks against dense normal equations."""

import numpy as np
import pytest

from fleetmap import core
from fleetmap.geometry import AnyArray, Array
from mapserver.calibration.estimator import BorderedLandmarks
from mapserver.calibration.image_rows import ImageRows

KEYFRAMES, LANDMARKS, COLUMNS = 4, 7, 5
STRIDE = 6
SIZE = STRIDE * KEYFRAMES + COLUMNS


def scene(seed: int) -> tuple[ImageRows, AnyArray, AnyArray]:
    rng = np.random.default_rng(seed)
    seen = [rng.permutation(KEYFRAMES)[: 2 + n % 3] for n in range(LANDMARKS)]
    keyframes = np.concatenate(seen).astype(np.int64)
    starts = np.cumsum([0, *(len(s) for s in seen)])
    shapes = (4,), (4, 6), (4, 3), (4, COLUMNS)
    return ImageRows(*(rng.standard_normal((len(keyframes), *shape)) for shape in shapes)), keyframes, starts


def reduced(rows: ImageRows, keyframes: AnyArray, starts: AnyArray) -> tuple[Array, Array, BorderedLandmarks]:
    info, rhs = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    out = BorderedLandmarks(*(np.empty((LANDMARKS, *shape)) for shape in ((3, 3), (3,), (3, COLUMNS))))
    assert core.reduce_landmarks(rows, keyframes, starts, STRIDE, 0.0, info, rhs, out)
    return info, rhs, out


def test_the_reduced_system_is_the_schur_complement() -> None:
    rows, keyframes, starts = scene(0)
    jacobian = np.zeros((len(keyframes), 4, SIZE + 3 * LANDMARKS))
    for m, k in enumerate(keyframes):
        n = int(np.searchsorted(starts, m, side="right")) - 1
        jacobian[m, :, STRIDE * k : STRIDE * k + 6] = rows.by_keyframe[m]
        jacobian[m, :, STRIDE * KEYFRAMES : SIZE] = rows.by_calibration[m]
        jacobian[m, :, SIZE + 3 * n : SIZE + 3 * n + 3] = rows.by_point[m]
    dense = jacobian.reshape(-1, jacobian.shape[2])
    whole, pull = dense.T @ dense, -dense.T @ rows.residuals.ravel()
    share = np.linalg.solve(whole[SIZE:, SIZE:], whole[SIZE:, :SIZE]).T
    info, rhs, _ = reduced(rows, keyframes, starts)
    upper = np.triu(info[: STRIDE * KEYFRAMES, : STRIDE * KEYFRAMES])
    expected = whole[:SIZE, :SIZE] - share @ whole[SIZE:, :SIZE]
    np.testing.assert_allclose(upper, np.triu(expected[: STRIDE * KEYFRAMES, : STRIDE * KEYFRAMES]), atol=1e-6)
    np.testing.assert_allclose(info[:, -COLUMNS:], expected[:, -COLUMNS:], atol=1e-6)
    np.testing.assert_allclose(rhs, pull[:SIZE] - share @ pull[SIZE:], atol=1e-6)


@pytest.mark.parametrize("slope", [np.nan, np.inf, np.finfo(np.float64).max])
def test_a_landmark_that_is_not_finite_is_told(slope: float) -> None:
    rows, keyframes, starts = scene(4)
    rows.by_point[3, 1, 2] = slope
    out = BorderedLandmarks(*(np.empty((LANDMARKS, *shape)) for shape in ((3, 3), (3,), (3, COLUMNS))))
    assert not core.reduce_landmarks(rows, keyframes, starts, STRIDE, 0.0, np.zeros((SIZE, SIZE)), np.zeros(SIZE), out)


def test_derivatives_without_a_value_weigh_nothing() -> None:
    rng = np.random.default_rng(3)
    slopes, factors = rng.standard_normal((6, 4, 3)), rng.uniform(size=(6, 4))
    slopes[0, 1, 2], slopes[3, 0, 0], slopes[5, 3, 1] = np.nan, np.inf, -np.inf
    expected = np.nan_to_num(slopes) * factors[:, :, None]
    core.weigh(slopes, factors)
    assert np.array_equal(slopes, expected)
