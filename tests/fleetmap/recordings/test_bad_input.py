"""Folders that cannot be right: the message names the value and the next step, or the loss is counted."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings import RECORDING_FORMATS, OpenOptions, open_recording
from fleetmap.recordings.images import StoredImage, decode_grey
from fleetmap.sensors.samples import DataIssue
from support.recordings.recording_samples import (
    HEIGHT,
    WIDTH,
    make_sample,
    write_euroc,
    write_euroc_imu,
    write_kitti,
    write_tumvi,
)

SAMPLE = make_sample(4, imu_before_ns=3_000_000_000)


@pytest.fixture
def euroc(tmp_path: Path) -> Path:
    return write_euroc(tmp_path / "recording", SAMPLE)


def test_no_such_path(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nowhere does not exist"):
        open_recording(tmp_path / "nowhere")


def test_unknown_format_names_the_known_ones(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(RecordingError) as caught:
        open_recording(tmp_path)
    assert all(name in str(caught.value) for name in RECORDING_FORMATS)


def test_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="empty folder"):
        open_recording(tmp_path)


@pytest.mark.parametrize("name", ["../../../../secret.png", "/etc/passwd"])
def test_names_outside_of_the_recording(euroc: Path, name: str) -> None:
    table = euroc / "mav0/cam0/data.csv"
    table.write_text(table.read_text() + f"1900000000000000000,{name}\n")
    with pytest.raises(RecordingError, match=r"data\.csv, line \d+: .* is not inside the folder"):
        open_recording(euroc)


def test_missing_camera_folder(euroc: Path) -> None:
    shutil.rmtree(euroc / "mav0/cam0")
    with pytest.raises(RecordingError, match="cam0 is missing"):
        open_recording(euroc)


@pytest.mark.parametrize(("write", "gone"), [(write_kitti, "image_0"), (write_kitti, "image_1"), (write_tumvi, "cam0")])
def test_missing_camera_folder_elsewhere(tmp_path: Path, write: Callable[..., Path], gone: str) -> None:
    folder = write(tmp_path / "r", SAMPLE)
    shutil.rmtree(folder / gone)
    with pytest.raises(RecordingError, match=rf"{gone}.* is missing"):
        open_recording(folder)


def test_camera_folder_without_table_or_images(euroc: Path) -> None:
    (euroc / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n")
    with pytest.raises(RecordingError, match="names no image"):
        open_recording(euroc)
    (euroc / "mav0/cam0/data.csv").unlink()
    with pytest.raises(RecordingError, match=r"data\.csv cannot be read"):
        open_recording(euroc)


@pytest.mark.parametrize("name", ["1403636579763555584.png", f"{10**25}.png"])
@pytest.mark.parametrize("has_times", [True, False])
def test_names_of_kitti_images_that_are_no_number_of_a_frame(tmp_path: Path, name: str, has_times: bool) -> None:
    folder = write_kitti(tmp_path / "r", SAMPLE)
    if has_times:
        (folder / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    shutil.copy(next((folder / "image_0").iterdir()), folder / "image_0" / "².png")
    assert len(open_recording(folder)) == 4
    shutil.copy(folder / "image_0" / "².png", folder / "image_0" / name)
    with pytest.raises(RecordingError, match=rf"{name}.*times\.txt"):
        open_recording(folder)


def test_links_to_images_that_are_not_there_are_left_out_and_counted(euroc: Path) -> None:
    image = euroc / "mav0/cam0/data/image2.png"
    image.unlink()
    image.symlink_to("nowhere.png")
    recording = open_recording(euroc)
    assert recording.issues[0] == DataIssue("cam0: images missing", "1 of 4, the first is image2.png")


def test_zero_byte_image_is_left_out_and_counted(euroc: Path) -> None:
    (euroc / "mav0/cam0/data/image3.png").write_bytes(b"")
    recording = open_recording(euroc)
    assert len(recording) == 3
    assert any("without a byte" in issue.what and "image3.png" in issue.detail for issue in recording.issues)


def test_nothing_but_zero_byte_images(euroc: Path) -> None:
    for file in (euroc / "mav0/cam1/data").iterdir():
        file.write_bytes(b"")
    with pytest.raises(RecordingError, match=r"cam1: none of the 4 images .*4 without a byte"):
        open_recording(euroc)


@pytest.mark.parametrize("image_type", ["png", "jpg"])
def test_cut_image_is_left_out_instead_of_filled_with_grey(tmp_path: Path, image_type: str) -> None:
    folder = write_euroc(tmp_path / "r", SAMPLE, image_type=image_type)
    file = folder / f"mav0/cam0/data/image2.{image_type}"
    file.write_bytes(file.read_bytes()[:-900])
    recording = open_recording(folder)
    assert SAMPLE.stamps_ns[2] not in recording.frame_stamps_ns
    assert len(recording) == 3
    (issue, _) = recording.issues
    assert issue == DataIssue("cam0: images cut off", f"1 of 4, the first is image2.{image_type}")


def test_png_that_is_damaged_inside_costs_one_frame(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_euroc(tmp_path / "r", SAMPLE)
    file = folder / "mav0/cam0/data/image2.png"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x55
    file.write_bytes(data)
    recording = open_recording(folder)
    assert SAMPLE.stamps_ns[2] not in recording.frame_stamps_ns
    assert len([recording.read_frame(index) for index in range(len(recording))]) == 3
    assert recording.issues[0] == DataIssue("cam0: images damaged inside", "1 of 4, the first is image2.png")
    assert recording.damaged_ns.tolist() == [SAMPLE.stamps_ns[2]], "rows of a trajectory are counted with it"
    with pytest.raises(RecordingError, match="the png image is damaged"):
        decode_grey(StoredImage("file", bytes(data), "a robot's own"))
    assert capfd.readouterr().err == "", "libpng has nothing to say"


def test_image_that_is_none(euroc: Path) -> None:
    (euroc / "mav0/cam0/data/image2.png").write_bytes(b"this is no image at all")
    recording = open_recording(euroc)
    assert len(recording) == 3
    assert recording.issues[0] == DataIssue("cam0: images of no format that is read", "1 of 4, the first is image2.png")


def test_image_of_another_size_is_left_out_and_a_calibration_of_another_size_refused(euroc: Path) -> None:
    file = euroc / "mav0/cam1/data/image2.png"
    whole = file.read_bytes()
    cv2.imwrite(str(file), np.zeros((HEIGHT, WIDTH - 8), np.uint8))
    recording = open_recording(euroc)
    assert len(recording) == 3
    assert recording.issues[0].detail == f"1 of {WIDTH - 8}x{HEIGHT} left out, 3 have {WIDTH}x{HEIGHT} px"
    file.write_bytes(whole)
    sensor = euroc / "mav0/cam0/sensor.yaml"
    sensor.write_text(sensor.read_text().replace(f"[{WIDTH}, {HEIGHT}]", "[752, 480]"))
    with pytest.raises(RecordingError, match=r"752x480.*--calibration"):
        open_recording(euroc)


def test_accelerometer_in_g(euroc: Path) -> None:
    write_euroc_imu(euroc / "mav0/imu0/data.csv", SAMPLE.imu_stamps_ns, SAMPLE.gyro_radps, SAMPLE.accel_mps2 / 9.80665)
    with pytest.raises(RecordingError, match=r"in g \(median 1\.00"):
        open_recording(euroc)


def test_gyro_in_degrees(euroc: Path) -> None:
    write_euroc_imu(
        euroc / "mav0/imu0/data.csv", SAMPLE.imu_stamps_ns, np.degrees(SAMPLE.gyro_radps), SAMPLE.accel_mps2
    )
    with pytest.raises(RecordingError, match="degrees per second"):
        open_recording(euroc)


def test_backward_stamps_are_dropped_and_counted_never_sorted(euroc: Path) -> None:
    stamps = SAMPLE.imu_stamps_ns.copy()
    stamps[[50, 51]] = stamps[[51, 50]]
    stamps[80] = stamps[79]
    stamps[100] += 10**12  # one wild stamp costs itself alone
    write_euroc_imu(euroc / "mav0/imu0/data.csv", stamps, SAMPLE.gyro_radps, SAMPLE.accel_mps2)
    recording = open_recording(euroc)
    assert (np.diff(recording.imu.stamps_ns) > 0).all()
    assert len(recording.imu) == len(stamps) - 3
    (issue,) = recording.issues
    assert issue.what == "imu: stamps not increasing"
    assert f"3 of {len(stamps)}" in issue.detail
    kept = np.isin(SAMPLE.imu_stamps_ns, recording.imu.stamps_ns)
    np.testing.assert_array_equal(recording.imu.gyro_radps[:50], SAMPLE.gyro_radps[kept][:50])


def test_a_clock_that_runs_backwards_is_refused(euroc: Path) -> None:
    write_euroc_imu(euroc / "mav0/imu0/data.csv", SAMPLE.imu_stamps_ns[::-1], SAMPLE.gyro_radps, SAMPLE.accel_mps2)
    with pytest.raises(RecordingError, match="stamps go backwards"):
        open_recording(euroc)


def test_camera_stamps_backwards(euroc: Path) -> None:
    file = euroc / "mav0/cam0/data.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([lines[0], lines[1], lines[3], lines[2], lines[4]]))
    recording = open_recording(euroc)
    assert len(recording) == 3
    assert (np.diff(recording.frame_stamps_ns) > 0).all()
    assert any("cam0: stamps not increasing" in issue.what for issue in recording.issues)


def test_table_cut_off_in_the_middle_of_a_line(euroc: Path) -> None:
    file = euroc / "mav0/imu0/data.csv"
    text = file.read_text()
    file.write_text(text[: len(text) - 60])
    recording = open_recording(euroc)
    assert len(recording.imu) == len(SAMPLE.imu_stamps_ns) - 1
    assert any("unreadable lines" in issue.what and issue.detail.startswith("1 of") for issue in recording.issues)


def test_values_that_are_not_finite(euroc: Path) -> None:
    gyro = SAMPLE.gyro_radps.copy()
    gyro[7, 1] = np.nan
    write_euroc_imu(euroc / "mav0/imu0/data.csv", SAMPLE.imu_stamps_ns, gyro, SAMPLE.accel_mps2)
    recording = open_recording(euroc)
    assert np.isfinite(recording.imu.gyro_radps).all()
    assert any("impossible values" in issue.what for issue in recording.issues)


def test_truth_without_rotation_is_left_out(euroc: Path) -> None:
    file = euroc / "mav0/state_groundtruth_estimate0/data.csv"
    lines = file.read_text().splitlines()
    stamp = lines[2].split(",")[0]
    lines[2] = ",".join([stamp, *["0"] * 16])
    file.write_text("\n".join(lines))
    recording = open_recording(euroc)
    assert recording.ground_truth is not None
    assert len(recording.ground_truth) == 3
    assert any("unit quaternion" in issue.detail for issue in recording.issues)


def test_missing_sensor_yaml(euroc: Path) -> None:
    (euroc / "mav0/cam1/sensor.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"cam1/sensor\.yaml is missing.*--calibration FILE"):
        open_recording(euroc)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "cannot be read"),
        ("cam0: [", "is not YAML"),
        ("just words", "mapping"),
        ("left: {}", "no cam0"),
        ("cam0: 3", "cam0 is 3"),
        ("cam0: {camera_model: omni, distortion_model: radtan}", "omni with distortion radtan is not known"),
        (
            "cam0: {camera_model: pinhole, distortion_model: none, intrinsics: [-9, 9, 9, 9], resolution: [20, 20]}",
            "focal lengths",
        ),
    ],
)
def test_calibration_file_missing_or_nonsense(euroc: Path, tmp_path: Path, content: str | None, says: str) -> None:
    file = tmp_path / "rig.yaml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(CalibrationError, match=says) as caught:
        open_recording(euroc, OpenOptions(calibration_file=file))
    assert "rig.yaml" in str(caught.value)


def test_calibration_file_with_too_few_cameras(euroc: Path, tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    file.write_text(
        "cam0: {camera_model: pinhole, distortion_model: none, intrinsics: [200, 200, 160, 120], "
        f"resolution: [{WIDTH}, {HEIGHT}]}}"
    )
    with pytest.raises(CalibrationError, match="2 cameras are recorded, the calibration describes 1"):
        open_recording(euroc, OpenOptions(calibration_file=file))


def test_imu_without_mounting_is_not_used_and_said_so(euroc: Path, tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    lens = f"camera_model: pinhole, distortion_model: none, intrinsics: [200, 200, 160, 120], resolution: [{WIDTH}, {HEIGHT}]"
    rows = "[[1, 0, 0, -0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    file.write_text(f"cam0: {{{lens}}}\ncam1: {{{lens}, T_cn_cnm1: {rows}}}\n")
    recording = open_recording(euroc, OpenOptions(calibration_file=file))
    assert recording.sensor_set.value == "stereo"
    assert len(recording.imu) == 0
    assert [issue.what for issue in recording.issues] == ["imu not used"]
