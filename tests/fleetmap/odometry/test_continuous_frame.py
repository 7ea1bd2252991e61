"""A frame without jumps in a simulated bend; tests/locclient/daemon/test_publishers.py has gravity and frames that change."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.common import consistency, estimator_loop
from fleetmap.geometry import Array, se3_exp, se3_inverse
from fleetmap.odometry.estimate import ContinuousFrame, OdometryEstimate

STEP = se3_exp(np.array([0.0, 0.0, 0.02, 1.0, 0.0, 0.0]))


def drive(frames: int) -> Array:
    out = [np.eye(4)]
    for _ in range(frames - 1):
        out.append(out[-1] @ STEP)
    return np.array(out)


def estimate(odom_from_body: Array) -> SimpleNamespace:
    return SimpleNamespace(odom_from_body=odom_from_body, previous_from_body=None, new_odom_from_old_odom=None)


def steps_of(frame_from_body: Array) -> Array:
    return se3_inverse(frame_from_body[:-1]) @ frame_from_body[1:]


def test_without_a_motion_estimates_follow_each_other_as_they_are() -> None:
    truth, frame = drive(5), ContinuousFrame()
    found = np.array([frame.handle(estimate(t)) for t in truth])
    np.testing.assert_array_equal(found, truth)


@pytest.fixture(scope="module")
def bend() -> tuple[list[OdometryEstimate], Array]:
    """Twelve seconds straight on and into a first bend, in which tilt and accelerometer bias come apart."""
    session = consistency.Site().session(2001)
    return estimator_loop.run_odometry(session, 200), session.map_from_body[:200]


def test_no_frame_of_a_bend_jumps(bend: tuple[list[OdometryEstimate], Array]) -> None:
    """Seen: a robot's `odom` 9 cm up and down from frame to frame, while each motion was known to millimetres."""
    estimates, truth = bend
    first = next(k for k, e in enumerate(estimates) if e.inertial)
    frame = ContinuousFrame()
    found = np.array([frame.handle(e) for e in estimates])[first:]
    off = se3_inverse(steps_of(truth[first:])) @ steps_of(found)
    apart = se3_inverse(steps_of(truth[first:])) @ steps_of(np.array([e.odom_from_body for e in estimates[first:]]))
    assert np.linalg.norm(apart[:, :3, 3], axis=1).max() > 0.03  # else this shows nothing
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.01
