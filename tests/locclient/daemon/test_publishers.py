"""Estimates that a running robot publishes, and the frame odom in which nothing jumps."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import se3, se3_inverse, so3_exp
from fleetmap.messages import Cause, EstimateMessage, Status, decode_message
from locclient.outputs import OutputSection
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.estimates import BASE_FROM_BODY, estimate, published


def test_messagepack_holds_both_transforms() -> None:
    tracked = estimate(5.0, x_m=2.0, sigma_m=0.1)
    lost = replace(estimate(6.0, Status.AMBIGUOUS, known=False, hypotheses=2), cause=Cause.DARK)
    told = published(OutputSection(), tracked, lost)
    assert list(told) == ["fleetmap/hall/robots/r1/estimate"]
    first, second = (decode_message(payload, EstimateMessage) for payload in told["fleetmap/hall/robots/r1/estimate"])
    assert (first.stamp_ns, first.status, first.map_version) == (5 * 10**9, "TRACKING", 3)
    map_from_base = first.map_from_odom.target_from_source @ first.odom_from_base.target_from_source
    np.testing.assert_allclose(map_from_base, tracked.map_from_body @ se3_inverse(BASE_FROM_BODY), atol=1e-12)
    assert first.cov_rot_trans[35] == pytest.approx(0.01 + 0.2**2 * 1e-4), "of the base, 0.2 m aside"
    assert (first.cause, second.cause) == ("", "dark")
    assert (second.map_from_odom, second.cov_rot_trans, len(second.hypotheses)) == (None, None, 2)


def test_odom_is_continuous_once_a_place_was_named() -> None:
    change = se3(so3_exp(np.array([0.0, 0.0, 0.4])), np.array([3.0, 1.0, 0.0]))
    frame = ContinuousOdom(np.eye(4))
    early = frame.handle(estimate(0.0, known=False, change=change))
    np.testing.assert_array_equal(early.odom_from_base, estimate(0.0).odometry.odom_from_body)
    before = frame.handle(estimate(1.0, x_m=1.0))
    redefined = estimate(1.1, x_m=1.1, change=change)
    object.__setattr__(redefined.odometry, "odom_from_body", change @ redefined.odometry.odom_from_body)
    after = frame.handle(redefined)
    np.testing.assert_allclose(after.odom_from_base[:3, 3] - before.odom_from_base[:3, 3], [0.1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(after.map_from_odom @ after.odom_from_base, redefined.map_from_body, atol=1e-12)
    np.testing.assert_allclose(after.map_from_odom, before.map_from_odom, atol=1e-12)


def test_gravity_that_becomes_better_known_goes_into_map_from_odom() -> None:
    """It turns the odometry's frame about an origin 12 m behind: 7 cm for the body, none of which was driven."""
    turn, step = se3(so3_exp(np.array([0.0, 0.006, 0.0])), np.zeros(3)), se3(np.eye(3), np.array([0.1, 0.0, 0.0]))
    frame = ContinuousOdom(np.eye(4))
    before = frame.handle(estimate(1.0, x_m=2.0))
    turned = estimate(1.1, x_m=2.1)
    object.__setattr__(turned.odometry, "odom_from_body", turn @ turned.odometry.odom_from_body)
    object.__setattr__(turned.odometry, "previous_from_body", step)
    after = frame.handle(turned)
    np.testing.assert_allclose(after.odom_from_base, before.odom_from_base @ step, atol=1e-12)
    np.testing.assert_allclose(after.map_from_odom @ after.odom_from_base, turned.map_from_body, atol=1e-12)
