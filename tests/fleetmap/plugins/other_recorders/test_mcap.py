"""MCAP files of other recorders: topics, lenses and encodings."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import se3_exp
from fleetmap.plugins.other_recorders.decoders import decode_camera_info
from fleetmap.recordings import OpenOptions, Recording, format_calibration, open_recording
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.mcap import reader
from fleetmap.recordings.ros2 import messages as ros_messages
from fleetmap.sensors.cameras import lens_of
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet
from support.recordings.bag_samples import edited
from support.recordings.mcap_samples import IMU, SAMPLE, foreign_messages, write_foreign
from support.recordings.recording_samples import HEIGHT, WIDTH, calibration, kalibr_text
from support.recordings.rig_samples import simulated, write_rig


def assert_is_the_sample(recording: Recording) -> None:
    np.testing.assert_array_equal(recording.frame_stamps_ns, SAMPLE.stamps_ns)
    np.testing.assert_array_equal(recording.imu.gyro_radps, IMU.gyro_radps)
    for index in (3, 0, 1):
        frame = recording.read_frame(index)
        np.testing.assert_array_equal(frame.left, SAMPLE.left[index])
        np.testing.assert_array_equal(frame.right, SAMPLE.right[index])


@pytest.mark.parametrize("rig", ["front-depth", "front-sides"])
def test_files_of_this_project_are_the_same_for_both_readers(tmp_path: Path, rig: str) -> None:
    calibration, frames = simulated(rig)
    path = write_rig(tmp_path / "a.mcap", calibration, frames)
    with reader.open_mcap(path, OpenOptions()) as plain, open_recording(path) as recording:
        for name in ("format", "name", "sensor_set", "issues"):
            assert getattr(plain, name) == getattr(recording, name)
        assert format_calibration(plain.calibration) == format_calibration(recording.calibration)
        assert plain.content_hash() == recording.content_hash()
        np.testing.assert_array_equal(plain.frame_stamps_ns, recording.frame_stamps_ns)
        for one, other in zip(plain.read_frame(0).others, recording.read_frame(0).others, strict=True):
            np.testing.assert_array_equal(one.left, other.left)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("topics", "options"),
    [
        ({}, {"compression": CompressionType.ZSTD}),
        ({}, {"compression": CompressionType.LZ4}),
        ({}, {"use_chunking": False}),
        ({}, dict.fromkeys(("use_summary_offsets", "use_statistics", "repeat_channels", "repeat_schemas"), False)),
        ({}, {"enable_crcs": False}),
        ({"left": "/camera/left/image_raw", "right": "/camera/right/image_raw", "imu": "/sensors/imu"}, {}),
    ],
    ids=["zstd", "lz4", "unchunked", "no summary", "no checksums", "other topics"],
)
def test_all_ways_to_store_and_to_name_it(tmp_path: Path, topics: dict[str, str], options: dict[str, Any]) -> None:
    with open_recording(write_foreign(tmp_path / "a.mcap", foreign_messages(**topics), **options)) as recording:
        assert recording.issues == ()
        assert_is_the_sample(recording)


def test_calibration_by_camera_info_and_transforms(tmp_path: Path) -> None:
    recording = open_recording(write_foreign(tmp_path / "a.mcap", foreign_messages()))
    assert recording.calibration.imu is not None
    for ours, wanted in zip(recording.calibration.cameras, calibration().cameras, strict=True):
        np.testing.assert_allclose(ours.body_from_cam, wanted.body_from_cam, atol=1e-9)
        np.testing.assert_array_equal(ours.intrinsics_px, wanted.intrinsics_px)
    base_from_imu = se3_exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
    np.testing.assert_allclose(recording.calibration.base_from_body, base_from_imu, atol=1e-9)


def test_no_transform_to_the_imu_nor_between_cameras(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"the pose of the right camera is unknown.*--calibration"):
        open_recording(write_foreign(tmp_path / "a.mcap", foreign_messages(tf=False)))


def test_topics_noted_in_the_calibration_file(tmp_path: Path) -> None:
    text = kalibr_text().replace("/cam0/image_raw", "/a/image").replace("/cam1/image_raw", "/b/image")
    (tmp_path / "rig.yaml").write_text(text)
    path = write_foreign(tmp_path / "a.mcap", foreign_messages(left="/a/image", right="/b/image", tf=False))
    with open_recording(path, OpenOptions(calibration_file=tmp_path / "rig.yaml")) as recording:
        assert_is_the_sample(recording)


LEFT = [message for message in foreign_messages() if message[0].startswith("/cam0/")]
INFO = LEFT[1]


def mono(tmp_path: Path, lens: str, distortion: list[float]) -> Recording:
    """A camera whose CameraInfo rosbags wrote."""
    messages = edited(LEFT, INFO[0], {"distortion_model": lens, "d": np.array(distortion)})
    return open_recording(write_foreign(tmp_path / "a.mcap", messages))


RATIONAL = [0.42, 0.03, 2e-4, -1e-4, 1e-3, 0.72, 0.14, 4e-3]


@pytest.mark.parametrize(
    ("lens", "distortion", "model", "kept"),
    [
        ("plumb_bob", [0.1, 0.2, 0.0, 0.0, 0.05], "radial-tangential", 5),
        ("equidistant", [0.1, 0.2, 0.0, 0.01], "equidistant", 4),
        ("double-sphere", [0.0, 0.0, 0.0, 0.0, -0.2, 0.6], "double-sphere", 6),
        ("rational_polynomial", [*RATIONAL, *[0.0] * 6], "radial-tangential", 8),
        ("inverse_brown_conrady", [0.0] * 5, "radial-tangential", 0),
        ("", [], "radial-tangential", 0),
    ],
)
def test_lenses(tmp_path: Path, lens: str, distortion: list[float], model: str, kept: int) -> None:
    recording = mono(tmp_path, lens, distortion)
    camera = recording.calibration.cameras[0]
    assert (recording.sensor_set, camera.model) == (SensorSet.MONO, model)
    assert camera.distortion.tolist() == distortion[:kept]
    Rectifier(recording.calibration).rectify(recording.read_frame(0))
    if kept:  # as this project writes it
        back = decode_camera_info(ros_messages.encode_camera_info(1, "cam0", camera))
        assert lens_of(back.lens, back.distortion, "")[1].tolist() == distortion[:kept]


@pytest.mark.parametrize(
    ("lens", "distortion", "says"),
    [
        ("rational_polynomial", [*RATIONAL, *[0.0] * 5, 0.01], r"14 distortion coefficients.*tilted sensors"),
        ("plumb_bob", [0.1], r"1 distortion coefficients \[0.1\] for plumb_bob"),
        ("plumb_bob", [np.nan] * 5, "not finite"),
        ("inverse_brown_conrady", [0.1] * 5, "'inverse_brown_conrady' is not supported"),
        ("omnidirectional", [0.0] * 4, "'omnidirectional' is not supported"),
    ],
)
def test_other_lenses_are_refused_by_name(tmp_path: Path, lens: str, distortion: list[float], says: str) -> None:
    with pytest.raises(CalibrationError, match=says) as caught:
        mono(tmp_path, lens, distortion)
    assert "calibrat" in str(caught.value)


def test_images_of_every_encoding(tmp_path: Path) -> None:
    grey = SAMPLE.left[0]
    colour = cv2.merge([grey, grey // 2, 255 - grey])
    wanted = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
    padded = np.zeros((HEIGHT, WIDTH + 12), np.uint8)
    padded[:, :WIDTH] = grey
    deep = grey.astype(np.uint16) * 256
    cases = [
        (StoredImage("bgr8", colour.tobytes(), "", WIDTH, HEIGHT, 3 * WIDTH), wanted),
        (StoredImage("rgb8", colour[..., ::-1].tobytes(), "", WIDTH, HEIGHT, 3 * WIDTH), wanted),
        (StoredImage("mono16", deep.astype("<u2").tobytes(), "", WIDTH, HEIGHT, 2 * WIDTH), grey),
        (StoredImage("mono16", deep.astype(">u2").tobytes(), "", WIDTH, HEIGHT, 2 * WIDTH, True), grey),
        (StoredImage("mono8", padded.tobytes(), "", WIDTH, HEIGHT, WIDTH + 12), grey),
    ]
    encoded = [ros_messages.encode_image(stamp, "c", image) for stamp, (image, _) in enumerate(cases, start=1)]
    messages = [("/cam0/image_raw", "sensor_msgs/Image", stamp, data) for stamp, data in enumerate(encoded, start=1)]
    recording = open_recording(write_foreign(tmp_path / "a.mcap", [INFO, *messages]))
    for index, (_, expected) in enumerate(cases):
        np.testing.assert_array_equal(recording.read_frame(index).left, expected)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "png"])
def test_depth_beside_colour(tmp_path: Path, encoding: str) -> None:
    depth_mm = np.full((HEIGHT, WIDTH), 2500, np.uint16)
    depth_mm[:5], depth_mm[5:9] = 0, 65535
    if encoding == "png":
        name, image = "sensor_msgs/CompressedImage", StoredImage("file", cv2.imencode(".png", depth_mm)[1].tobytes())
        message = ros_messages.encode_compressed_image(LEFT[0][2], "c", image, "16UC1; png compressed")
    else:
        pixels = depth_mm if encoding == "16UC1" else np.where(depth_mm == 2500, np.float32(2.5), np.float32(np.nan))
        rows = StoredImage(encoding, pixels.tobytes(), "", WIDTH, HEIGHT, pixels.strides[0])
        name, message = "sensor_msgs/Image", ros_messages.encode_image(LEFT[0][2], "c", rows)
    topic, now = "/depth/image_raw" + ("/compressed" if encoding == "png" else ""), LEFT[0][2]
    recording = open_recording(write_foreign(tmp_path / "a.mcap", [*LEFT[:2], (topic, name, now, message)]))
    assert recording.sensor_set is SensorSet.RGBD
    depth = recording.read_frame(0).depth_m
    np.testing.assert_array_equal(depth, np.where(depth_mm == 2500, np.float32(2.5), np.float32(0)))


def test_a_rosbag2_folder(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    write_foreign(bag / "bag_0.mcap", foreign_messages())
    with open_recording(bag) as recording:
        assert_is_the_sample(recording)
    write_foreign(bag / "other_1.mcap", foreign_messages())
    with pytest.raises(RecordingError, match=r"holds 2 \.mcap files of several recordings \(bag, other\)"):
        open_recording(bag)
