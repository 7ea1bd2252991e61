"""The rotation helpers of numba loops against the plain ones and against numeric derivatives."""

import numpy as np
import pytest

from fleetmap.geometry import so3_exp, so3_left_jacobian, so3_log
from fleetmap.inertial.so3_kernels import inverse_left_jacobian_into, log_into, right_jacobian_into
from fleetmap.numerics.linear_kernels import exp_into

AXES = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1], [0.6, -0.48, 0.64], [-0.3, 0.9, 0.316227766]])
ANGLES = [0.0, 1e-12, 1e-6, 0.99e-4, 1.01e-4, 0.99e-2, 1.01e-2, 0.5, 2.0, 3.0, np.pi - 1e-7]


@pytest.mark.parametrize("angle_rad", ANGLES)
def test_agree_with_plain_formulas(angle_rad: float) -> None:
    for axis in AXES / np.linalg.norm(AXES, axis=1)[:, None]:
        rotvec, rotation, back, jacobian = angle_rad * axis, np.empty((3, 3)), np.empty(3), np.empty((3, 3))
        exp_into(rotvec, rotation)
        np.testing.assert_allclose(rotation, so3_exp(rotvec), atol=1e-14)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        log_into(rotation, back)
        np.testing.assert_allclose(back, so3_log(rotation), atol=1e-9)
        np.testing.assert_allclose(back, rotvec, atol=1e-8)
        right_jacobian_into(rotvec, jacobian)
        np.testing.assert_allclose(jacobian, so3_left_jacobian(-rotvec), atol=1e-7)
        inverse_left_jacobian_into(rotvec, jacobian)
        np.testing.assert_allclose(jacobian @ so3_left_jacobian(rotvec), np.eye(3), atol=1e-7)


@pytest.mark.parametrize("angle_rad", [0.3, 2.5])
def test_inverse_jacobian_is_the_derivative_of_log(angle_rad: float) -> None:
    rotvec, jacobian = angle_rad * AXES[3], np.empty((3, 3))
    inverse_left_jacobian_into(rotvec, jacobian)
    for k in range(3):
        nudge = 1e-6 * np.eye(3)[k]
        change = (so3_log(so3_exp(nudge) @ so3_exp(rotvec)) - so3_log(so3_exp(-nudge) @ so3_exp(rotvec))) / 2e-6
        np.testing.assert_allclose(jacobian[:, k], change, atol=1e-8)
