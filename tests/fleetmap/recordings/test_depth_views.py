"""A depth camera as one view of a rig beside a stereo pair: recordings, calibration files, topics and rectification."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings import OpenOptions, Recording, Topics, format_calibration, open_recording, read_calibration
from fleetmap.recordings.mcap import writer
from fleetmap.recordings.mcap.writer import McapRecordingWriter, copy_to_mcap
from fleetmap.sensors.rectification import RGBD_BASELINE_M, Rectifier
from fleetmap.sensors.samples import CameraFrame, SensorSet
from support.plugins import needs_plugin
from support.recordings.rig_samples import simulated, write_rig


def rear(frame: CameraFrame) -> CameraFrame:
    (other,) = frame.others
    return other


def written(file: Path, frames: tuple[CameraFrame, ...] | None = None) -> Path:
    return write_rig(file, simulated("front-depth")[0], frames or simulated("front-depth")[1])


def check(recording: Recording) -> None:
    assert recording.calibration.views == ((0, 1), (2,)) and not recording.issues
    assert recording.sensor_set is SensorSet.STEREO
    for index, frame in enumerate(simulated("front-depth")[1]):
        found = rear(recording.read_frame(index))
        np.testing.assert_array_equal(found.left, rear(frame).left)
        np.testing.assert_array_equal(found.depth_m, rear(frame).depth_m)


def test_depth_beside_a_pair_is_written_read_and_copied(tmp_path: Path) -> None:
    with open_recording(written(tmp_path / "a.mcap")) as recording:
        check(recording)
        copy_to_mcap(recording, tmp_path / "b.mcap")
        alone = recording.view(1)
        assert alone.sensor_set is SensorSet.RGBD and alone.content_hash() != ""
        np.testing.assert_array_equal(alone.read_frame(2).depth_m, rear(simulated("front-depth")[1][2]).depth_m)
        part = recording.part(np.array([2]))
        np.testing.assert_array_equal(rear(part.read_frame(0)).depth_m, alone.read_frame(2).depth_m)
        assert recording.view(0).read_frame(0).others == ()
    with open_recording(tmp_path / "b.mcap") as copy:
        check(copy)


@needs_plugin("mcap")
def test_without_a_calibration_file_the_topic_says_that_a_camera_has_depth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "CALIBRATION_ATTACHMENT", "something else.yaml")
    with open_recording(written(tmp_path / "a.mcap")) as recording:
        check(recording)
        assert [camera.has_depth for camera in recording.calibration.cameras] == [False, False, True]


def test_a_depth_camera_is_no_half_of_a_pair() -> None:
    """Two that look the same way are two views; the depth is that of the pixels, as a pair's disparity over RGBD_BASELINE_M."""
    calibration, frames = simulated("front-depth")
    both = replace(calibration, cameras=(*calibration.cameras, calibration.cameras[2]))
    assert both.views == ((0, 1), (2,), (3,))
    assert replace(both, cameras=tuple(replace(c, has_depth=False) for c in both.cameras)).views == ((0, 1), (2, 3))
    rectifier = Rectifier(calibration)
    assert [each.camera.baseline_m for each in rectifier.mounted] == pytest.approx([0.12, RGBD_BASELINE_M])
    seen = rectifier.rectify(frames[0]).view(1)
    assert seen is not None and seen.disparity_px is not None and seen.right is None
    depth_m = rear(frames[0]).depth_m
    known = depth_m > 0
    assert known.mean() > 0.2 and np.isnan(seen.disparity_px[~known]).all()
    focal_px = rectifier.mounted[1].camera.focal_px
    np.testing.assert_allclose(focal_px * RGBD_BASELINE_M / seen.disparity_px[known], depth_m[known], rtol=1e-5)
    small = replace(rear(frames[0]), depth_m=depth_m[::2, ::2])
    assert rectifier.rectify(replace(frames[0], others=(small,))).view(1) is None


def test_the_calibration_file_keeps_it_and_refusals_name_the_camera(tmp_path: Path) -> None:
    calibration, frames = simulated("front-depth")
    file = tmp_path / "camchain.yaml"
    file.write_text(format_calibration(calibration))
    assert read_calibration(file).cameras[2].has_depth
    file.write_text(format_calibration(calibration).replace("has_depth: true", "has_depth: z16"))
    with pytest.raises(CalibrationError, match="cam2: has_depth is 'z16'; write true or false"):
        read_calibration(file)
    first = replace(calibration, cameras=(replace(calibration.cameras[0], has_depth=True), *calibration.cameras[1:]))
    file.write_text(format_calibration(first))
    with pytest.raises(CalibrationError, match=r"cam0: has_depth is .* number a stereo pair cam0 and cam1"):
        read_calibration(file)
    grey = tuple(replace(f, others=(replace(rear(f), depth_m=None),)) for f in frames)
    with pytest.raises(CalibrationError, match=r"has_depth of cam2 \(--topic cam2_depth=/NAME\)"):
        open_recording(written(tmp_path / "grey.mcap", grey))
    plain = replace(calibration, cameras=tuple(replace(c, has_depth=False) for c in calibration.cameras))
    file.write_text(format_calibration(plain))
    with open_recording(written(tmp_path / "a.mcap"), OpenOptions(calibration_file=file)) as recording:
        (other,) = recording.read_frame(0).others
        assert other is not None and other.depth_m is None
    large = replace(rear(frames[0]), depth_m=np.ones((20, 20), np.float32))
    with pytest.raises(RecordingError, match=r"the depth image at .* is 20x20 px, the colour image 96x72"):
        open_recording(written(tmp_path / "large.mcap", (replace(frames[0], others=(large,)),)))


def test_cameras_beside_a_depth_camera_in_front_are_named_with_what_to_do(tmp_path: Path) -> None:
    calibration, frames = simulated("front-depth")
    two = replace(calibration, cameras=(replace(calibration.cameras[2], has_depth=False), calibration.cameras[0]))
    with McapRecordingWriter(tmp_path / "a.mcap", two, topics=Topics(right="/cam2/image_raw")) as target:
        for frame in frames:
            target.write_frame(replace(rear(frame), others=(CameraFrame(frame.stamp_ns, frame.left),)))
    with open_recording(tmp_path / "a.mcap") as recording:
        assert recording.sensor_set is SensorSet.RGBD
        (issue,) = recording.issues
        assert issue.what == "images not used" and "let a stereo pair be left and right" in issue.detail
