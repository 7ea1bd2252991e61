"""Estimates that a running robot publishes, and the frame odom in which nothing jumps."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import se3, se3_inverse, so3_exp
from fleetmap.messages import Cause, EstimateMessage, Status, decode_message
from fleetmap.recordings.ros2.cdr import CdrReader
from fleetmap.recordings.ros2.graph import RmwZenohKeys
from fleetmap.recordings.ros2.messages import decode_frame_links, decode_prior
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sources.intake import Intake
from locclient.daemon.publishers import open_publisher
from locclient.output_section import OutputSection
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.estimates import estimate
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.recordings.recording_samples import calibration

BASE_FROM_BODY = se3(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.2, 0.0, 0.5]))


def inputs(bus: MemoryBus) -> tuple[MemoryBus, str, str, RigCalibration, Intake]:
    intake = Intake(frames=1, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0)
    return (bus, "hall", "r1", calibration(), intake)


def published(section: OutputSection, *estimates: object) -> dict[str, list[bytes]]:
    """Payloads by key, of estimates one after another."""
    hub, heard = MemoryHub(), {}  # type: ignore[var-annotated]
    with MemoryBus(hub) as bus, MemoryBus(hub) as other:
        other.subscribe("**", lambda key, payload: heard.setdefault(key, []).append(payload))
        publisher, odom = open_publisher(section, *inputs(bus)), ContinuousOdom(BASE_FROM_BODY)
        for one in estimates:
            publisher.publish(one, odom.handle(one), BASE_FROM_BODY)  # type: ignore[arg-type]
        publisher.close()
    return heard


def test_messagepack_holds_both_transforms() -> None:
    tracked = estimate(5.0, x_m=2.0, sigma_m=0.1)
    lost = replace(estimate(6.0, Status.AMBIGUOUS, known=False, hypotheses=2), cause=Cause.DARK)
    told = published(OutputSection(), tracked, lost)
    assert list(told) == ["fleetmap/hall/robots/r1/estimate"]
    first, second = (decode_message(payload, EstimateMessage) for payload in told["fleetmap/hall/robots/r1/estimate"])
    assert (first.stamp_ns, first.status, first.map_version) == (5 * 10**9, "TRACKING", 3)
    assert first.map_from_odom is not None
    map_from_base = first.map_from_odom.target_from_source @ first.odom_from_base.target_from_source
    np.testing.assert_allclose(map_from_base, tracked.map_from_body @ se3_inverse(BASE_FROM_BODY), atol=1e-12)
    assert first.cov_rot_trans is not None
    assert first.cov_rot_trans[35] == pytest.approx(0.01 + 0.2**2 * 1e-4), "of the base, 0.2 m aside"
    assert (first.cause, second.cause) == ("", "dark")
    assert (second.map_from_odom, second.cov_rot_trans, len(second.hypotheses)) == (None, None, 2)


def test_ros_topics_hold_the_same() -> None:
    tracked = estimate(5.0, x_m=2.0, sigma_m=0.1)
    told = published(OutputSection(format="ros2", domain=3), tracked, estimate(6.0, Status.LOST, known=False))
    expected = tracked.map_from_body @ se3_inverse(BASE_FROM_BODY)
    stamped = told[RmwZenohKeys(3).key("/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped")]
    assert len(stamped) == 1
    prior = decode_prior(stamped[0])
    np.testing.assert_allclose(prior.map_from_base, expected, atol=1e-12)
    levers_m2 = np.array([0.2**2 + 0.5**2, 0.5**2, 0.2**2])  # of the base about the body, which is turned by 90 degrees
    np.testing.assert_allclose(np.diag(prior.cov_rot_trans), [*[1e-4] * 3, *(0.01 + 1e-4 * levers_m2)])
    links = [
        link
        for payload in told[RmwZenohKeys(3).key("/tf", "tf2_msgs/TFMessage")]
        for link in decode_frame_links(payload)
    ]
    assert [(link.parent, link.child) for link in links] == [("map", "odom"), *[("odom", "base_link")] * 2]
    np.testing.assert_allclose(links[0].parent_from_child @ links[1].parent_from_child, expected, atol=1e-12)
    states = told[RmwZenohKeys(3).key("/localization/status", "std_msgs/String")]
    assert [CdrReader(state).text() for state in states] == ["TRACKING", "LOST"]


def test_the_building_is_told_once_the_map_says_it() -> None:
    """Beside the cameras' frames, in one message: late subscribers get the last one alone. Not again with every frame."""
    building_from_map = se3(so3_exp(np.array([0.0, 0.0, 0.5])), np.array([3.0, -4.0, 0.0]))
    hub, heard = MemoryHub(), []
    key = RmwZenohKeys(0).key("/tf_static", "tf2_msgs/TFMessage")
    with MemoryBus(hub) as bus, MemoryBus(hub) as other:
        other.subscribe(key, lambda _, payload: heard.append(decode_frame_links(payload)))
        publisher = open_publisher(OutputSection(format="ros2", building_frame="building"), *inputs(bus))
        odom = ContinuousOdom(BASE_FROM_BODY)
        for known in (None, building_from_map, building_from_map.copy(), None):
            one = estimate(5.0)
            placed = replace(odom.handle(one), building_from_map=known)
            publisher.publish(one, placed, BASE_FROM_BODY)  # type: ignore[arg-type]
        publisher.close()
    assert [len(links) for links in heard] == [3, 4]
    assert (heard[1][3].parent, heard[1][3].child) == ("building", "map")
    np.testing.assert_allclose(heard[1][3].parent_from_child, building_from_map, atol=1e-12)
    told = published(OutputSection(format="ros2"), estimate(5.0))
    assert [len(decode_frame_links(payload)) for payload in told[key]] == [3]


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
