"""Folders that cannot be right: the message names the value and the next step, or the loss is counted."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings import OpenOptions, open_recording, recording_formats
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
STAMPS_NS, GYRO, ACCEL = SAMPLE.imu_stamps_ns, SAMPLE.gyro_radps, SAMPLE.accel_mps2
LENS = (
    f"camera_model: pinhole, distortion_model: none, intrinsics: [200, 200, 160, 120], resolution: [{WIDTH}, {HEIGHT}]"
)
Spoil = Callable[[Path], object]


@pytest.fixture
def euroc(tmp_path: Path) -> Path:
    return write_euroc(tmp_path / "recording", SAMPLE)


def image(folder: Path, camera: int = 0, number: int = 2) -> Path:
    return folder / f"mav0/cam{camera}/data/image{number}.png"


def edit(name: str, change: Callable[[list[str]], object]) -> Spoil:
    """Changes the lines of a file of the folder."""

    def spoil(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        changed = change(lines)
        (folder / name).write_text("\n".join(lines if changed is None else changed))

    return spoil


def imu(stamps_ns: np.ndarray = STAMPS_NS, gyro: np.ndarray = GYRO, accel: np.ndarray = ACCEL) -> Spoil:
    return lambda folder: write_euroc_imu(folder / "mav0/imu0/data.csv", stamps_ns, gyro, accel)


def dangling(folder: Path) -> None:
    image(folder).unlink()
    image(folder).symlink_to("nowhere.png")


def bytes_of_image(change: Callable[[bytes], bytes]) -> Spoil:
    return lambda folder: image(folder).write_bytes(change(image(folder).read_bytes()))


flipped = bytes_of_image(lambda data: data[:500] + bytes([data[500] ^ 0x55]) + data[501:])


def moved(numbers: str) -> Spoil:
    """Other numbers in a row of the truth."""
    return edit(TRUTH, lambda rows: [*rows[:2], f"{rows[2].partition(',')[0]},{numbers}", *rows[3:]])


def nothing_left(folder: Path) -> None:
    for number in range(4):
        image(folder, 1, number).write_bytes(b"")


CAMERA, TABLE, TRUTH = "mav0/cam0/data.csv", "mav0/imu0/data.csv", "mav0/state_groundtruth_estimate0/data.csv"
SENSOR = "mav0/cam0/sensor.yaml"
LARGER_LENS = edit(SENSOR, lambda rows: [row.replace(f"[{WIDTH}, {HEIGHT}]", "[752, 480]") for row in rows])


def test_paths_that_are_no_recording(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nowhere does not exist"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="empty folder"):
        open_recording(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(RecordingError) as caught:
        open_recording(tmp_path)
    assert all(name in str(caught.value) for name in recording_formats())


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (edit(CAMERA, lambda rows: rows.append("1900000000000000000,../../../../secret.png")), r"data\.csv, line \d+: .* is not inside"),
        (edit(CAMERA, lambda rows: rows.append("1900000000000000000,/etc/passwd")), r"data\.csv, line \d+: .* is not inside"),
        (edit(CAMERA, lambda rows: rows[:1]), "names no image"),
        (lambda folder: (folder / CAMERA).unlink(), r"data\.csv cannot be read"),
        (lambda folder: shutil.rmtree(folder / "mav0/cam0"), "cam0 is missing"),
        (nothing_left, r"cam1: none of the 4 images .*4 without a byte"),
        (LARGER_LENS, "752x480.*--calibration"),
        (lambda folder: (folder / "mav0/cam1/sensor.yaml").unlink(), r"cam1/sensor\.yaml is missing.*--calibration FILE"),
        (imu(accel=ACCEL / 9.80665), r"in g \(median 1\.00"),
        (imu(gyro=np.degrees(GYRO)), "degrees per second"),
        (imu(STAMPS_NS[::-1]), "stamps go backwards"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_named(euroc: Path, spoil: Spoil, says: str) -> None:
    spoil(euroc)
    with pytest.raises(RecordingError, match=says):
        open_recording(euroc)


@pytest.mark.parametrize(
    ("spoil", "frames", "says"),
    [
        (dangling, 3, "cam0: images missing: 1 of 4, the first is image2.png"),
        (bytes_of_image(lambda data: b""), 3, "cam0: images without a byte: 1 of 4, the first is image2.png"),
        (bytes_of_image(lambda data: b"none"), 3, "cam0: images of no format that is read: 1 of 4, the first is image2.png"),
        (bytes_of_image(lambda data: data[:-900]), 3, "cam0: images cut off: 1 of 4, the first is image2.png"),
        (flipped, 3, "cam0: images damaged inside: 1 of 4, the first is image2.png"),
        (
            lambda folder: cv2.imwrite(str(image(folder, 1)), np.zeros((HEIGHT, WIDTH - 8), np.uint8)), 3,
            f"cam1: images of another size: 1 of {WIDTH - 8}x{HEIGHT} left out, 3 have {WIDTH}x{HEIGHT} px",
        ),
        (edit(CAMERA, lambda rows: [rows[at] for at in (0, 1, 3, 2, 4)]), 3, "cam0: stamps not increasing"),
        (edit(TABLE, lambda rows: [*rows[:-1], rows[-1][:-60]]), 4, "data.csv: unreadable lines: 1 of"),
        (imu(gyro=np.where(np.arange(len(GYRO))[:, None] == 7, np.nan, GYRO)), 4, "imu: impossible values: 1 of"),
        (moved("0" + 15 * ",0"), 4, "ground truth: no rotation: 1 of 4 rows without a unit quaternion"),
        (moved("1e308,-1e308,0,1" + 12 * ",0"), 4, "ground truth: no rotation: 1 of 4 rows without a unit quaternion or a near position"),
    ],
)  # fmt: skip
def test_what_is_lost_is_counted(euroc: Path, spoil: Spoil, frames: int, says: str) -> None:
    spoil(euroc)
    recording = open_recording(euroc)
    assert len([recording.read_frame(index) for index in range(len(recording))]) == frames
    assert (np.diff(recording.frame_stamps_ns) > 0).all()
    assert np.isfinite(recording.imu.gyro_radps).all()
    assert any(f"{issue.what}: {issue.detail}".startswith(says) for issue in recording.issues), recording.issues


@pytest.mark.parametrize(("write", "gone"), [(write_kitti, "image_0"), (write_kitti, "image_1"), (write_tumvi, "cam0")])
def test_missing_camera_folder_elsewhere(tmp_path: Path, write: Callable[..., Path], gone: str) -> None:
    folder = write(tmp_path / "r", SAMPLE)
    shutil.rmtree(folder / gone)
    with pytest.raises(RecordingError, match=rf"{gone}.* is missing"):
        open_recording(folder)


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


def test_backward_stamps_are_dropped_and_counted_never_sorted(euroc: Path) -> None:
    stamps = STAMPS_NS.copy()
    stamps[[50, 51]] = stamps[[51, 50]]
    stamps[80] = stamps[79]
    stamps[100] += 10**12  # one wild stamp costs itself alone
    imu(stamps)(euroc)
    recording = open_recording(euroc)
    assert (np.diff(recording.imu.stamps_ns) > 0).all()
    assert len(recording.imu) == len(stamps) - 3
    (issue,) = recording.issues
    assert issue.what == "imu: stamps not increasing"
    assert f"3 of {len(stamps)}" in issue.detail
    kept = np.isin(STAMPS_NS, recording.imu.stamps_ns)
    np.testing.assert_array_equal(recording.imu.gyro_radps[:50], GYRO[kept][:50])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "cannot be read"),
        ("cam0: [", "is not YAML"),
        ("just words", "mapping"),
        ("left: {}", "no cam0"),
        ("cam0: 3", "cam0 is 3"),
        ("cam0: {camera_model: fov, distortion_model: radtan}", "fov with distortion radtan is not known"),
        (f"cam0: {{{LENS.replace('200, 200', '-9, 9')}}}", "focal lengths"),
        (f"cam0: {{{LENS}}}", "2 cameras are recorded, the calibration describes 1"),
    ],
)
def test_calibration_file_missing_or_nonsense(euroc: Path, tmp_path: Path, content: str | None, says: str) -> None:
    file = tmp_path / "rig.yaml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(CalibrationError, match=says) as caught:
        open_recording(euroc, OpenOptions(calibration_file=file))
    assert re.search(r"rig\.yaml|--calibration FILE", str(caught.value))


def test_imu_without_mounting_is_not_used_and_said_so(euroc: Path, tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    rows = "[[1, 0, 0, -0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    file.write_text(f"cam0: {{{LENS}}}\ncam1: {{{LENS}, T_cn_cnm1: {rows}}}\n")
    recording = open_recording(euroc, OpenOptions(calibration_file=file))
    assert recording.sensor_set.value == "stereo"
    assert len(recording.imu) == 0
    assert [issue.what for issue in recording.issues] == ["imu not used"]
