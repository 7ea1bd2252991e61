"""What odometry says of keyframes: through darkness, and where it began anew."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fleetmap.geometry import se3, se3_exp, se3_inverse, so3_exp
from mapserver.survey.bundle.odometry_factors import blackout_factors
from mapserver.survey.keyframes.connected_components import SigmaBetween
from mapserver.survey.odometry_pass import OdometryPass, continued_covariances
from support.worlds.corridor_scene import scene


def estimate(cov: float, change: np.ndarray | None = None, *, inertial: bool = True) -> SimpleNamespace:
    return SimpleNamespace(cov_rot_trans=cov * np.eye(6), new_odom_from_old_odom=change, inertial=inertial)


def test_only_what_touches_the_dark_hangs_on_odometry_as_odometry_measured_it() -> None:
    given = scene(8, 3, drift=0.0)
    state = given.state
    dark = (state.landmarks.obs_keyframe == 3) | (state.landmarks.obs_keyframe == 4)
    state = replace(state, landmarks=state.landmarks.keep_observations(~dark, 1))
    truth = state.map_from_body.copy()
    odom_from_body = se3_exp(np.array([0.3, 0.1, -0.2, 4.0, 2.0, 1.0])) @ truth
    keyframes = [SimpleNamespace(frame_index=k) for k in range(8)]
    guess = OdometryPass(
        [], odom_from_body, np.arange(8)[:, None, None] * 1e-4 * np.eye(6), np.ones(8, bool), keyframes, inertial=True,
        has_wheels=True,
    )  # fmt: skip
    state.map_from_body[3:5, 0, 3] += 7.0  # where an adjustment may have put them says nothing
    terms = blackout_factors(guess, state)
    assert [(t.i, t.j) for t in terms] == [(2, 3), (3, 4), (4, 5)]
    for term in terms:
        np.testing.assert_allclose(term.i_from_j, se3_inverse(truth[term.i]) @ truth[term.j], atol=1e-9)
        sigmas_m = np.sqrt(np.diag(np.linalg.inv(term.information)))[3:]
        assert (sigmas_m > 0.01).all()
        assert (sigmas_m < 0.05).all()
    # Without wheels the odometry of sparse pictures knows less than it says, and nothing that the IMU does not.
    assert not blackout_factors(replace(guess, has_wheels=False), state)


def test_beginning_anew_does_not_join_what_nothing_joins() -> None:
    """An odometry that begins anew takes its place for known: the doubt of before goes on, and one metre with it."""
    turn = se3(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    whole = continued_covariances(
        [estimate(0.0), estimate(0.01), estimate(0.04), estimate(0.0, np.eye(4), inertial=False), estimate(0.01)]
    )
    between = SigmaBetween(np.trace(whole[:, 3:, 3:], axis1=1, axis2=2))
    assert between(1, 2) == pytest.approx(np.sqrt(3 * 0.03))
    assert between(2, 3) > 1.0
    assert between(3, 4) == pytest.approx(np.sqrt(3 * 0.01))
    first = np.diag([0.0, 0.0, 0.0, 0.04, 0.01, 0.0])
    seen = SimpleNamespace(cov_rot_trans=first, new_odom_from_old_odom=None, inertial=False)
    begun = continued_covariances([seen, estimate(0.0, turn)])
    np.testing.assert_allclose(np.diag(begun[1]), [0.0, 0.0, 0.0, 0.01, 0.04, 0.0], atol=1e-12)
