"""Small products in kernels, against numpy and `geometry`."""

import numpy as np
import pytest

from fleetmap.geometry import se3, se3_adjoint, se3_exp, se3_inverse, so3_exp
from fleetmap.numerics import transform_kernels as kernels
from fleetmap.numerics.linear_kernels import exp_so3, matmul, rotate


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


@pytest.mark.parametrize("shape", [(3, 3, 3), (4, 4, 4), (6, 15, 6), (5, 7, 2)])
def test_products_are_numpys(rng: np.random.Generator, shape: tuple[int, int, int]) -> None:
    a, b = rng.normal(size=shape[:2]), rng.normal(size=shape[1:])
    a[0, :] = 0.0
    np.testing.assert_allclose(matmul(a, b), a @ b, rtol=1e-13, atol=1e-14)
    in_order = np.zeros((shape[0], shape[2]))
    for k in range(shape[1]):
        in_order += a[:, k, None] * b[k]
    np.testing.assert_array_equal(matmul(a, b), in_order)


@pytest.mark.parametrize("size", [1e-8, 0.3, 1.5])
def test_rotations_and_transforms_are_those_of_geometry(rng: np.random.Generator, size: float) -> None:
    rotvec, vector = size * rng.normal(size=3) / np.sqrt(3.0), rng.normal(size=3)
    first, second = se3(so3_exp(rotvec), vector), se3_exp(rng.normal(size=6))
    close = {"rtol": 1e-13, "atol": 1e-14}
    np.testing.assert_allclose(exp_so3(rotvec), so3_exp(rotvec), **close)
    np.testing.assert_allclose(rotate(first[:3, :3].copy(), vector), first[:3, :3] @ vector, **close)
    np.testing.assert_allclose(kernels.adjoint(first), se3_adjoint(first), **close)
    rotations, positions = np.stack([first, second])[:, :3, :3].copy(), np.stack([first, second])[:, :3, 3].copy()
    between = kernels.earlier_from_later(rotations, positions, 0, 1)
    np.testing.assert_allclose(between, se3_inverse(first) @ second, **close)
    assert kernels.angle_between_rad(second, second @ first) == pytest.approx(
        np.linalg.norm(rotvec), rel=1e-6, abs=1e-12
    )
    off = second @ se3_inverse(first)
    assert kernels.distance_between(second, first) == pytest.approx(float(np.linalg.norm(off[:3, 3])))
