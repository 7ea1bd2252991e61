"""A depth camera beside a pair, from live topics."""

import numpy as np

from fleetmap.recordings import Topics
from fleetmap.recordings.images import decode_depth, decode_frame, store_frame
from fleetmap.recordings.ros2 import messages
from fleetmap.sources.intake import Intake
from locclient.plugins.ros2_node.keys import RmwZenohKeys
from locclient.plugins.ros2_node.source import RigFrames, Ros2Source
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.recordings.rig_samples import simulated


def test_live_images_and_depth_make_one_view() -> None:
    frames, stored = RigFrames(simulated("front-depth")[0]), store_frame(simulated("front-depth")[1][0])
    (back,) = stored.others
    assert back is not None and back.depth is not None and stored.right is not None
    done = []
    for k in range(4):
        stamp_ns = 1_000_000_000 + k * 50_000_000
        done += frames.add(2, stamp_ns, back.left)
        done += frames.add(2, stamp_ns, back.depth, is_depth=True)
        done += frames.add(0, stamp_ns, stored.left) + frames.add(1, stamp_ns, stored.right)
    assert len(done) == 4
    for frame in done:
        (other,) = frame.others
        assert other is not None and other.right is None and other.depth is back.depth and frame.depth is None


def test_a_live_source_takes_the_topic_of_a_cameras_depth() -> None:
    calibration, frames = simulated("front-depth")
    hub, queue = MemoryHub(), Intake(frames=9, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0)
    topics, stored = Topics(cam2_depth="/back/aligned_depth"), store_frame(frames[0])
    (back,) = stored.others
    assert back is not None
    with MemoryBus(hub) as driver, MemoryBus(hub) as robot:
        Ros2Source(robot, RmwZenohKeys(0), topics, calibration).subscribe(queue)
        for topic, image in (
            (topics.cam2, back.left),
            ("/back/aligned_depth", back.depth),
            (topics.left, stored.left),
            (topics.right, stored.right),
        ):
            assert image is not None
            payload = messages.encode_image(stored.stamp_ns, "cam", image)
            driver.publish(RmwZenohKeys(0).key(topic, "sensor_msgs/Image"), payload)
    frame = queue.take(1.0).frame
    assert frame is not None
    decoded = decode_frame(frame)  # type: ignore[arg-type]
    np.testing.assert_array_equal(decoded.others[0].depth_m, frames[0].others[0].depth_m)
    assert decode_depth(back.depth).shape == (72, 96)  # type: ignore[arg-type]
