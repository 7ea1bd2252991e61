"""What every recording format must do."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from fleetmap.errors import RecordingError
from fleetmap.recordings import OpenOptions, Recording, format_calibration, open_recording, recording_formats
from fleetmap.recordings.mcap.writer import copy_to_mcap
from fleetmap.sensors.samples import CameraFrame
from support.recordings.bag_samples import write_rosbag1, write_rosbag2
from support.recordings.mcap_samples import Message
from support.recordings.recording_samples import (
    calibration,
    kalibr_text,
    make_sample,
    world_from_cam0,
    write_euroc,
    write_kitti,
    write_mcap,
    write_seven_scenes,
    write_tum_rgbd,
    write_tumvi,
    write_video,
)
from support.recordings.rig_samples import write_kitti_raw

SAMPLE = make_sample(5)
WITHOUT_TRUTH = ("video", "kitti-raw")


def _write_mcap(folder: Path) -> Path:
    copy_to_mcap(open_recording(write_mcap(folder / "source", SAMPLE)), folder / "copy.mcap")
    return folder / "copy.mcap"


def _write_kitti_raw(folder: Path) -> Path:
    frames = list(map(CameraFrame, SAMPLE.stamps_ns.tolist(), SAMPLE.left, SAMPLE.right))
    return write_kitti_raw(folder / "drive", calibration(), frames)


def _messages(folder: Path) -> list[Message]:
    """Those of an MCAP file, its calibration as /tf_static and CameraInfo have it."""
    with _write_mcap(folder).open("rb") as file:
        return [
            (channel.topic, (schema.name if schema else "").replace("/msg/", "/"), message.log_time, message.data)
            for schema, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


WRITERS: dict[str, Callable[[Path], Path]] = {
    "euroc": lambda folder: write_euroc(folder, SAMPLE),
    "tumvi": lambda folder: write_tumvi(folder, SAMPLE),
    "kitti": lambda folder: write_kitti(folder, SAMPLE),
    "kitti-raw": _write_kitti_raw,
    "7scenes": lambda folder: write_seven_scenes(folder, SAMPLE),
    "tum-rgbd": lambda folder: write_tum_rgbd(folder, SAMPLE),
    "mcap": _write_mcap,
    "rosbag2-sqlite": lambda folder: write_rosbag2(folder / "bag", _messages(folder)),
    "video": lambda folder: write_video(folder.with_suffix(".mp4"), SAMPLE.left, [50 * n for n in range(5)]),
    "rosbag1": lambda folder: write_rosbag1(folder / "a.bag", _messages(folder)),
}
WITHOUT_CALIBRATION = ("tum-rgbd", "video")


@pytest.fixture(params=list(recording_formats()), scope="module")
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return WRITERS[request.param](tmp_path_factory.mktemp(request.param) / "recording")


def opened(path: Path) -> Recording:
    """The recording, with the rig's calibration where its format holds none."""
    formats = {name for name, f in recording_formats().items() if f.recognises(path)}
    if not formats & set(WITHOUT_CALIBRATION):
        return open_recording(path)
    rig = path.parent / "rig.yaml"
    rig.write_text(kalibr_text().partition("cam1:")[0])
    return open_recording(path, OpenOptions(rig))


def test_each_format_has_a_writer_here() -> None:
    assert set(WRITERS) >= set(recording_formats())  # fewer without plug-ins


def test_exactly_its_own_format_recognises_it(path: Path) -> None:
    assert len([name for name, f in recording_formats().items() if f.recognises(path)]) == 1


def test_stamps_increase_and_images_are_the_samples(path: Path) -> None:
    recording = opened(path)
    assert [issue.what for issue in recording.issues] == ["stamps uncertain"] * (recording.format == "video")
    assert len(recording) == len(SAMPLE.left)
    assert (np.diff(recording.frame_stamps_ns) > 0).all()
    for index in (3, 0, 4, 4):
        frame = recording.read_frame(index)
        assert frame.left.dtype == np.uint8
        np.testing.assert_array_equal(frame.left, SAMPLE.left[index])
        if frame.right is not None:
            np.testing.assert_array_equal(frame.right, SAMPLE.right[index])
        if frame.depth_m is not None:
            assert frame.depth_m.dtype == np.float32


def test_the_hash_is_that_of_a_copy_elsewhere_and_not_of_another_recording(path: Path, tmp_path: Path) -> None:
    first = opened(path).content_hash()
    elsewhere = tmp_path / "elsewhere"
    (shutil.copytree if path.is_dir() else shutil.copy)(path, elsewhere)
    assert opened(elsewhere).content_hash() == first
    image = max((p for p in (elsewhere, *elsewhere.rglob("*")) if p.is_file()), key=lambda p: p.stat().st_size)
    image.write_bytes(image.read_bytes() + b"\0")
    assert opened(elsewhere).content_hash() != first


def test_truth_is_that_of_the_body(path: Path) -> None:
    recording = opened(path)
    if recording.format in WITHOUT_TRUTH:
        pytest.skip("it holds no truth")
    for index, stamp_ns in enumerate(recording.frame_stamps_ns):
        frame_from_body = recording.ground_truth.at(int(stamp_ns))
        frame_from_cam = frame_from_body @ recording.calibration.cameras[0].body_from_cam
        np.testing.assert_allclose(frame_from_cam, world_from_cam0(int(SAMPLE.stamps_ns[index])), atol=1e-9)


def test_a_conversion_to_mcap_loses_nothing(path: Path, tmp_path: Path) -> None:
    source = opened(path)
    copy_to_mcap(source, tmp_path / "converted.mcap")
    with open_recording(tmp_path / "converted.mcap") as copy:
        assert copy.issues == source.issues
        assert (copy.name, copy.sensor_set) == (source.name, source.sensor_set)
        np.testing.assert_array_equal(source.frame_stamps_ns, copy.frame_stamps_ns)
        for index in (len(source) - 1, 0, 2):  # in no order
            a, b = source.read_frame(index), copy.read_frame(index)
            assert a.stamp_ns == b.stamp_ns == source.frame_stamps_ns[index]
            for image in ("left", "right", "depth_m"):
                np.testing.assert_array_equal(getattr(a, image), getattr(b, image))
        for field in ("stamps_ns", "gyro_radps", "accel_mps2"):
            np.testing.assert_array_equal(getattr(source.imu, field), getattr(copy.imu, field))
        assert format_calibration(copy.calibration) == format_calibration(source.calibration)
        assert (source.ground_truth is None) == (copy.ground_truth is None) == (source.format in WITHOUT_TRUTH)
        if source.ground_truth is None or copy.ground_truth is None:
            return
        np.testing.assert_allclose(copy.ground_truth.frame_from_body, source.ground_truth.frame_from_body, atol=1e-12)


def test_a_frame_outside_is_refused_and_closing_twice_is_fine(path: Path) -> None:
    recording = opened(path)
    for index in (-1, len(recording)):
        with pytest.raises(RecordingError, match=str(index)):
            recording.read_frame(index)
    recording.close()
    recording.close()
