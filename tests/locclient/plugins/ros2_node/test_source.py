"""Sensors as a ROS 2 driver publishes them through rmw_zenoh, over real zenoh on loopback."""

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.bus import Bus
from fleetmap.errors import UsageError
from fleetmap.recordings import StoredFrame, Topics
from fleetmap.recordings.images import decode_frame, depth_image, grey_image, png_image
from fleetmap.recordings.ros2.messages import (
    encode_compressed_image,
    encode_image,
    encode_imu,
    encode_odometry,
    encode_prior,
)
from fleetmap.sensors.samples import ImuSamples, PositionPrior, WheelSample
from fleetmap.sensors.source_settings import SourceSection
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import open_source
from locclient.plugins.ros2_node.keys import RmwZenohKeys, attachment
from locclient.plugins.ros2_node.source import Ros2Source, StereoPairs
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.recordings.recording_samples import calibration

TOPICS = Topics(left="/rig/left/image_raw", right="/rig/right/image_raw", imu="/rig/imu")
GID = bytes(range(16))
LEFT = np.arange(48, dtype=np.uint8).reshape(6, 8)
RIGHT = LEFT[:, ::-1].copy()


def intake() -> Intake:
    return Intake(frames=10, imu_minus_cam_s=0.0, has_imu=True, imu_wait_s=0.0)


@pytest.fixture
def buses() -> Iterator[tuple[Bus, Bus]]:
    """A driver's router and a robot's session."""
    with Bus.listen("tcp/127.0.0.1:0") as driver, Bus.connect(driver.endpoint) as robot:
        yield driver, robot


def test_topics_of_a_driver_become_moments(buses: tuple[Bus, Bus]) -> None:
    driver, robot = buses
    queue, sent = intake(), 0

    def send(topic: str, type_name: str, payload: bytes) -> None:
        nonlocal sent
        sent += 1
        driver.publish(RmwZenohKeys(7).key(topic, type_name), payload, attachment=attachment(sent, sent, GID))

    source = Ros2Source(robot, RmwZenohKeys(7), TOPICS, calibration())
    handles = source.subscribe(queue)
    deadline = time.monotonic() + 20
    while not queue.counts.imu_samples and time.monotonic() < deadline:  # until the subscription stands
        send(TOPICS.imu, "sensor_msgs/Imu", encode_imu(time.time_ns(), "imu", np.ones(3), np.ones(3)))
        time.sleep(0.02)
    start_ns = time.time_ns()
    for number in range(4):
        stamp_ns = start_ns + number * 50_000_000
        send(TOPICS.right, "sensor_msgs/Image", encode_image(stamp_ns + 1_000_000, "r", grey_image(RIGHT)))
        send(
            TOPICS.left + "/compressed",
            "sensor_msgs/CompressedImage",
            encode_compressed_image(stamp_ns, "l", png_image(LEFT), "png"),
        )
        send(TOPICS.imu, "sensor_msgs/Imu", encode_imu(stamp_ns, "imu", np.array([1.0, 2, 3]), np.array([0, 0, 9.8])))
        send(
            "/odom",
            "nav_msgs/Odometry",
            encode_odometry(WheelSample(stamp_ns, np.ones(3), 0.1, 0.1, 0.1), "odom", "base"),
        )
    send(
        "/prior",
        "geometry_msgs/PoseWithCovarianceStamped",
        encode_prior(PositionPrior(start_ns, np.eye(4), np.eye(6)), "map"),
    )
    send(TOPICS.imu, "sensor_msgs/Imu", b"nonsense")
    while queue.counts.unreadable < 1 and time.monotonic() < deadline:  # topics keep no order among each other
        time.sleep(0.01)
    send(
        "/prior",
        "geometry_msgs/PoseWithCovarianceStamped",
        encode_prior(PositionPrior(start_ns, np.eye(4), np.eye(6)), "odom"),
    )
    while (queue.counts.frames < 4 or queue.counts.unreadable < 2) and time.monotonic() < deadline:
        time.sleep(0.01)
    moments = [queue.take(1.0) for _ in range(4)]
    assert [moment.frame.stamp_ns for moment in moments] == [start_ns + n * 50_000_000 for n in range(4)]
    assert isinstance(moments[0].frame, StoredFrame)
    decoded = decode_frame(moments[0].frame)
    np.testing.assert_array_equal(decoded.left, LEFT)
    np.testing.assert_array_equal(decoded.right, RIGHT)
    np.testing.assert_allclose(moments[1].imu.gyro_radps, [[1.0, 2.0, 3.0]])
    assert len(moments[0].priors) == 1
    assert [len(moment.wheel) for moment in moments] == [1, 1, 1, 1]
    assert queue.counts.unreadable == 2
    assert "position prior in the frame 'odom' is not used; give it in 'map'" in queue.unreadable_why
    for handle in handles:
        handle.close()


def test_running_ends_when_it_is_told_and_hears_nothing_more() -> None:
    hub = MemoryHub()
    with MemoryBus(hub) as bus, MemoryBus(hub) as driver:
        queue, source = intake(), Ros2Source(bus, RmwZenohKeys(0), TOPICS, calibration())

        def publish_and_stop(_: float) -> bool:
            for stamp_ns in (5, 6):
                payload = encode_imu(stamp_ns, "imu", np.ones(3), np.ones(3))
                driver.publish(RmwZenohKeys(0).key(TOPICS.imu, "sensor_msgs/Imu"), payload)
            return True

        source.run(queue, publish_and_stop)
        assert queue.counts.imu_samples == 2
        publish_and_stop(0.0)
        assert (queue.counts.imu_samples, queue.counts.imu_refused) == (2, 0)
        source.close()


def test_pairs_are_by_stamp_and_the_lonely_are_counted() -> None:
    pairs, image = StereoPairs(), grey_image(LEFT)
    assert pairs.add("left", 0, image) is None
    assert pairs.add("left", 50_000_000, image) is None
    found = pairs.add("right", 51_000_000, image)
    assert found is not None
    assert found.stamp_ns == 50_000_000
    assert pairs.unpaired == 1
    for number in range(20):
        assert pairs.add("right", (100 + 50 * number) * 1_000_000, image) is None
    assert pairs.unpaired == 13


@pytest.mark.parametrize("has_depth", [False, True])
def test_one_camera_needs_no_right_image(has_depth: bool) -> None:
    hub, queue = MemoryHub(), intake()
    depth_m = np.full((6, 8), 1.5, np.float32)
    with MemoryBus(hub) as driver:
        rig = replace(calibration(), cameras=calibration().cameras[:1])
        source = Ros2Source(MemoryBus(hub), RmwZenohKeys(7), TOPICS, rig, has_depth=has_depth)
        source.subscribe(queue)
        for topic, image in (("left", grey_image(LEFT)), ("right", grey_image(RIGHT)), ("depth", depth_image(depth_m))):
            name = {"left": TOPICS.left, "right": TOPICS.right, "depth": TOPICS.depth}[topic]
            driver.publish(RmwZenohKeys(7).key(name, "sensor_msgs/Image"), encode_image(50, "cam0", image))
        queue.put_imu(ImuSamples(np.array([10**9]), np.zeros((1, 3)), np.zeros((1, 3))))
        found = queue.take(1.0).frame
    assert isinstance(found, StoredFrame)
    frame = decode_frame(found)
    np.testing.assert_array_equal(frame.left, LEFT)
    assert frame.right is None
    if has_depth:
        assert frame.depth_m is not None
        np.testing.assert_array_equal(frame.depth_m, depth_m)
    else:
        assert frame.depth_m is None


def test_a_uvc_camera_has_a_pair() -> None:
    with pytest.raises(UsageError, match="uvc camera sends pairs"):
        open_source(SourceSection(kind="uvc", sensors="mono"), TOPICS)
