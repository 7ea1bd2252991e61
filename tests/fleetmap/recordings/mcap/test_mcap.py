"""MCAP: what other people's readers see in our files, and what ours sees in theirs."""

import resource
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from fleetmap.errors import RecordingError
from fleetmap.geometry import se3, se3_exp, so3_exp
from fleetmap.recordings import OpenOptions, Topics, format_calibration, open_recording
from fleetmap.recordings.mcap import reader
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, PositionPrior, SensorSet, Trajectory, WheelSample
from support.recordings.mcap_samples import IMU, SAMPLE
from support.recordings.recording_samples import calibration

WHEEL = WheelSample(int(SAMPLE.stamps_ns[1]), np.array([0.5, 0.01, 0.0]), 0.25, 0.02, 0.03)
PLACE = se3(so3_exp(np.array([0.0, 0.0, 0.7])), np.array([1.0, 2.0, 0.0]))
PRIOR = PositionPrior(int(SAMPLE.stamps_ns[0]), PLACE, np.diag([np.inf, np.inf, 0.1, 0.04, 0.05, np.inf]))
TRUTH = Trajectory(SAMPLE.stamps_ns, np.stack(SAMPLE.world_from_body))


def write(path: Path, **keywords: Any) -> Path:
    with McapRecordingWriter(path, keywords.pop("calibration", calibration()), **keywords) as writer:
        writer.write_imu(IMU)
        writer.write_wheel([WHEEL])
        writer.write_prior([PRIOR])
        writer.write_ground_truth(TRUTH)
        for stamp, left, right in zip(SAMPLE.stamps_ns.tolist(), SAMPLE.left, SAMPLE.right, strict=True):
            writer.write_frame(CameraFrame(stamp, left, right))
    return path


def test_all_that_is_written_is_read(tmp_path: Path) -> None:
    late = tuple(replace(camera, imu_minus_cam_s=0.0123) for camera in calibration().cameras)
    rig = RigCalibration(late, calibration().imu, se3_exp(np.arange(6) / 10.0))
    again = write(tmp_path / "b.mcap", name="aisle", calibration=rig).read_bytes()
    assert write(tmp_path / "a.mcap", name="aisle", calibration=rig).read_bytes() == again
    with open_recording(tmp_path / "a.mcap") as recording:
        assert format_calibration(recording.calibration) == format_calibration(rig)
        assert (recording.name, recording.format, recording.issues) == ("aisle", "mcap", ())
        assert recording.sensor_set is SensorSet.STEREO_INERTIAL
        np.testing.assert_array_equal(recording.read_frame(2).left, SAMPLE.left[2])
        np.testing.assert_array_equal(recording.read_frame(0).right, SAMPLE.right[0])
        np.testing.assert_array_equal(recording.imu.accel_mps2, IMU.accel_mps2)
        np.testing.assert_array_equal(recording.imu.stamps_ns, IMU.stamps_ns)
        (wheel,) = recording.wheel
        np.testing.assert_array_equal(wheel.velocity_base_mps, WHEEL.velocity_base_mps)
        assert (wheel.stamp_ns, wheel.yaw_rate_radps) == (WHEEL.stamp_ns, WHEEL.yaw_rate_radps)
        assert (wheel.sigma_mps, wheel.sigma_radps) == pytest.approx((WHEEL.sigma_mps, WHEEL.sigma_radps))
        (prior,) = recording.priors
        np.testing.assert_allclose(prior.map_from_base, PRIOR.map_from_base, atol=1e-12)
        np.testing.assert_array_equal(prior.cov_rot_trans, PRIOR.cov_rot_trans)
        np.testing.assert_allclose(recording.ground_truth.frame_from_body, TRUTH.frame_from_body, atol=1e-12)


def test_nothing_is_left_of_a_recording_that_was_not_finished(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), McapRecordingWriter(tmp_path / "a.mcap", calibration()) as writer:
        writer.write_imu(IMU)
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(RecordingError, match="cannot be written"):
        McapRecordingWriter(tmp_path / "no" / "a.mcap", calibration())


@pytest.mark.parametrize("count", [1, 4])  # the disk is full at the end, or before
def test_a_full_disk_is_named_and_leaves_no_part(tmp_path: Path, count: int) -> None:
    path, in_place = tmp_path / "a.mcap", tmp_path / "b.mcap"
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    frame = CameraFrame(1, np.zeros((700, 1000), np.uint8), np.zeros((700, 1000), np.uint8))
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        full = pytest.raises(RecordingError, match=r"a\.mcap\.part cannot be written .*make space")
        with full, McapRecordingWriter(path, calibration()) as writer:
            for _ in range(count):
                writer.write_frame(frame)
        with pytest.raises(RecordingError, match=r"b\.mcap cannot be written .*it holds what came before"):
            kept = McapRecordingWriter(in_place, calibration(), in_place=True)
            for _ in range(count):
                kept.write_frame(frame)
            kept.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == [in_place]


def decoded(path: Path) -> Iterator[tuple[str, str, Any]]:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            yield channel.topic, schema.name, message


def test_the_ros_2_decoder_of_others_reads_every_message(tmp_path: Path) -> None:
    seen: dict[str, Any] = {}
    for topic, name, message in decoded(write(tmp_path / "a.mcap")):
        seen.setdefault(topic, (name, message))
    name, image = seen["/cam1/image_raw"]
    assert name == "sensor_msgs/msg/Image"
    assert bytes(image.data) == SAMPLE.right[0].tobytes()
    assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == SAMPLE.stamps_ns[0]
    assert seen["/imu0"][1].linear_acceleration.z == IMU.accel_mps2[0, 2]
    links = [(t.header.frame_id, t.child_frame_id) for t in seen["/tf_static"][1].transforms]
    assert links == [("body", "cam0"), ("body", "cam1"), ("base", "body")]
    assert {"/cam0/camera_info", "/odom", "/prior", "/ground_truth"} < set(seen)


@pytest.mark.parametrize(
    ("topics", "says"),
    [
        (Topics(left="/front"), "no topic /front of type sensor_msgs/Image or .* for --topic left; there is .*/cam0/"),
        (Topics(wheel="/wheels"), "no topic /wheels of type nav_msgs/Odometry for --topic wheel"),
        (Topics(wheel="", imu=""), ""),
    ],
)
def test_topics_that_were_named_must_be_there(tmp_path: Path, topics: Topics, says: str) -> None:
    path = write(tmp_path / "a.mcap")
    refused = pytest.raises(RecordingError, match=says) if says else nullcontext()
    with refused, reader.open_mcap(path, OpenOptions(topics=topics)) as recording:
        assert (recording.wheel, len(recording.imu), recording.sensor_set) == ((), 0, SensorSet.STEREO)
