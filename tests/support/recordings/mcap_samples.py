"""MCAP files as other recorders write them, with the content of the synthetic sample."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from fleetmap.geometry import se3, se3_exp
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.ros2 import messages as ros_messages
from fleetmap.recordings.ros2.cdr import ros2msg
from fleetmap.sensors.samples import ImuSamples
from support.recordings.recording_samples import BASELINE_M, BODY_FROM_CAM0, HEIGHT, WIDTH, calibration, make_sample

SAMPLE = make_sample(4)
IMU = ImuSamples(SAMPLE.imu_stamps_ns, SAMPLE.gyro_radps, SAMPLE.accel_mps2)
Message = tuple[str, str, int, bytes]


def write_foreign(
    path: Path,
    messages: list[Message],
    publishers: int = 1,
    log_delay_ns: Callable[[int], int] = lambda _: 0,
    **options: Any,
) -> Path:
    """ROS 2 messages (topic, type, stamp, bytes) by mcap's own writer; publishers take turns, each with channels of its own and a
    definition of its own. log_delay_ns: by stamp. The test is skipped without the plug-in that reads them."""
    pytest.importorskip("fleetmap.plugins.other_recorders")
    writer = Writer(str(path), **{"chunk_size": 20_000, "compression": CompressionType.NONE, **options})
    writer.start(profile="ros2", library="test")
    channels: dict[tuple[str, str, int], int] = {}
    turns = Counter[str]()
    for topic, name, stamp, data in messages:
        turns[topic] += 1
        publisher = turns[topic] % publishers
        if (topic, name, publisher) not in channels:
            definition = f"{ros2msg(name)}\n{'# of a later release' * publisher}".encode()
            schema = writer.register_schema(name.replace("/", "/msg/"), "ros2msg", definition)
            channels[topic, name, publisher] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channels[topic, name, publisher], stamp + log_delay_ns(stamp), data, stamp)
    writer.finish()
    return path


def foreign_messages(
    *, left: str = "/cam0/image_raw", right: str = "/cam1/image_raw", imu: str = "/imu0", tf: bool = True
) -> list[Message]:
    rig = calibration()
    messages: list[Message] = []
    for i, stamp in enumerate(SAMPLE.stamps_ns.tolist()):
        for number, (topic, images) in enumerate(((left, SAMPLE.left), (right, SAMPLE.right))):
            row_image = StoredImage("mono8", images[i].tobytes(), "", WIDTH, HEIGHT, WIDTH)
            frame = f"cam{number}_optical"
            messages.append((topic, "sensor_msgs/Image", stamp, ros_messages.encode_image(stamp, frame, row_image)))
            info = topic.rpartition("/")[0] + "/camera_info"
            encoded = ros_messages.encode_camera_info(stamp, frame, rig.cameras[number])
            messages.append((info, "sensor_msgs/CameraInfo", stamp, encoded))
    for stamp, gyro, accel in zip(IMU.stamps_ns.tolist(), IMU.gyro_radps, IMU.accel_mps2, strict=True):
        messages.append((imu, "sensor_msgs/Imu", stamp, ros_messages.encode_imu(stamp, "imu_link", gyro, accel)))
    if tf:
        # base_link -> imu_link, base_link -> cam0 -> cam1: a tree as robots have it
        base_from_imu = se3_exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
        links = [
            ros_messages.FrameLink("base_link", "imu_link", base_from_imu),
            ros_messages.FrameLink("base_link", "cam0_optical", base_from_imu @ BODY_FROM_CAM0),
            ros_messages.FrameLink("cam0_optical", "cam1_optical", se3(np.eye(3), np.array([BASELINE_M, 0, 0]))),
        ]
        data = ros_messages.encode_frame_links(1, links)
        messages.append(("/tf_static", "tf2_msgs/TFMessage", 1, data))
    return messages
