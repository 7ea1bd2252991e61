"""The scipy-free linear algebra against numpy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fleetmap.numerics import linear_kernels


@pytest.fixture(scope="module")
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


@pytest.mark.parametrize(("rows", "inner", "columns"), [(1, 1, 1), (3, 5, 2), (7, 4, 9)])
def test_products(rng: np.random.Generator, rows: int, inner: int, columns: int) -> None:
    a, b = rng.normal(size=(rows, inner)), rng.normal(size=(inner, columns))
    a[0, 0] = 0.0  # the product skips zeros
    np.testing.assert_allclose(linear_kernels.matmul(a, b), a @ b, atol=1e-13)
    np.testing.assert_allclose(linear_kernels.matmul_nt(a, np.ascontiguousarray(b.T)), a @ b, atol=1e-13)


@pytest.mark.parametrize("size", [1, 2, 6, 15])
def test_factor_and_solutions(rng: np.random.Generator, size: int) -> None:
    half = rng.normal(size=(size, size))
    spd, right = half @ half.T + 0.1 * np.eye(size), rng.normal(size=size)
    lower = spd.copy()
    assert linear_kernels.cholesky_in_place(lower)
    np.testing.assert_allclose(np.tril(lower), np.linalg.cholesky(spd), atol=1e-10)
    forward, solved, scratch = right.copy(), right.copy(), spd.copy()
    linear_kernels.forward_substitute(lower, forward)
    np.testing.assert_allclose(np.tril(lower) @ forward, right, atol=1e-10)
    assert linear_kernels.solve_spd(scratch, solved)
    np.testing.assert_allclose(spd @ solved, right, atol=1e-9)


@pytest.mark.parametrize("matrix", [np.diag([1.0, -1.0]), np.zeros((3, 3)), np.array([[1.0, 2.0], [2.0, 1.0]])])
def test_what_is_not_positive_definite_is_refused(matrix: np.ndarray) -> None:
    assert not linear_kernels.cholesky_in_place(matrix.copy())
    assert not linear_kernels.solve_spd(matrix.copy(), np.ones(len(matrix)))


def test_not_a_number_is_refused() -> None:
    assert not linear_kernels.cholesky_in_place(np.array([[np.nan]]))


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 5e-7, 2e-6, 0.1, 2.0, np.pi, 5.0])
def test_rotations(rng: np.random.Generator, angle_rad: float) -> None:
    axis = rng.normal(size=3)
    rotvec = angle_rad * axis / np.linalg.norm(axis)
    np.testing.assert_allclose(linear_kernels.exp_so3(rotvec), Rotation.from_rotvec(rotvec).as_matrix(), atol=1e-13)
