"""What is particular to single folder formats."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.encoding import to_json
from fleetmap.errors import CalibrationError
from fleetmap.geometry import se3, se3_inverse, so3_exp, transform_points
from fleetmap.plugins.datasets.euroc import read_camera
from fleetmap.plugins.datasets.seven_scenes import DepthRegistration
from fleetmap.recordings import OpenOptions, format_calibration, open_recording
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.samples import SensorSet
from support.recordings.realdata import real_data
from support.recordings.recording_samples import (
    BASELINE_M,
    BODY_FROM_CAM0,
    FOCAL,
    HEIGHT,
    WIDTH,
    calibration,
    make_sample,
    write_euroc,
    write_kitti,
    write_seven_scenes,
    write_tumvi,
)

SAMPLE = make_sample(4)


def test_a_name_that_is_no_utf_8_can_be_written_into_a_report(tmp_path: Path) -> None:
    path = write_euroc(tmp_path / "ride", SAMPLE).rename(tmp_path / os.fsdecode(b"ride-\xff"))
    with open_recording(path) as recording:
        assert recording.name == r"ride-\udcff"
        assert to_json({"name": recording.name})


@pytest.mark.parametrize("yaml_line", [True, False])
def test_euroc_with_and_without_opencvs_first_line(tmp_path: Path, yaml_line: bool) -> None:
    recording = open_recording(write_euroc(tmp_path / "r", SAMPLE, yaml_line=yaml_line))
    assert (recording.sensor_set, recording.name, recording.format) == (SensorSet.STEREO_INERTIAL, "r", "euroc")
    for ours, wanted in zip(recording.calibration.cameras, calibration().cameras, strict=True):
        np.testing.assert_array_equal(ours.body_from_cam, wanted.body_from_cam)
        np.testing.assert_array_equal(ours.intrinsics_px, wanted.intrinsics_px)
    assert recording.calibration.imu == calibration().imu
    np.testing.assert_array_equal(recording.imu.gyro_radps, SAMPLE.gyro_radps)
    assert recording.imu.stamps_ns[0] == SAMPLE.stamps_ns[0] - 500_000_000
    by_itself = open_recording(tmp_path / "r/mav0")
    assert (by_itself.name, by_itself.content_hash()) == ("r", recording.content_hash())


@pytest.mark.parametrize("place", ["sensor.yaml", "camchain.yaml", "--calibration"])
def test_a_recording_with_another_mask_is_another_recording(tmp_path: Path, place: str) -> None:
    """A night knows recordings by their hash: one whose mask was edited must not count as one that it has."""
    folder = write_euroc(tmp_path / "r", SAMPLE)
    sensor, chain = folder / "mav0/cam0/sensor.yaml", folder / "camchain.yaml"
    if place == "sensor.yaml":
        sensor.write_text(sensor.read_text() + "\nmask: robot.png\n")
    else:
        sensor.unlink()
        key = "  timeshift_cam_imu"
        chain.write_text(format_calibration(calibration()).replace(key, f"  mask: robot.png\n{key}", 1))
    options = OpenOptions(calibration_file=chain if place == "--calibration" else None)
    picture = (sensor if place == "sensor.yaml" else chain).with_name("robot.png")
    hashes = set()
    for row in (0, 5):
        camera = calibration().cameras[0]
        shown = np.zeros((camera.height_px, camera.width_px), np.uint8)
        shown[row : row + 20] = 255
        cv2.imwrite(str(picture), shown)
        hashes.add(open_recording(folder, options).content_hash())
    assert len(hashes) == 2


def test_euroc_without_second_camera_or_imu(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "r", SAMPLE)
    shutil.rmtree(folder / "mav0/cam1")
    mono = open_recording(folder)
    assert mono.sensor_set is SensorSet.MONO_INERTIAL
    assert mono.read_frame(0).right is None
    shutil.rmtree(folder / "mav0/imu0")
    assert open_recording(folder).sensor_set is SensorSet.MONO


def test_euroc_imu_that_is_not_the_body(tmp_path: Path) -> None:
    """The body is the IMU: cameras and truth are given in its axes, wherever EuRoC's body is."""
    folder = write_euroc(tmp_path / "r", SAMPLE)
    euroc_from_imu = se3(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.01, 0.02, 0.03]))
    file = folder / "mav0/imu0/sensor.yaml"
    text = file.read_text()
    start, end = text.index("data: [") + 7, text.index("]", text.index("data: ["))
    file.write_text(text[:start] + ", ".join(repr(float(v)) for v in euroc_from_imu.ravel()) + text[end:])
    recording = open_recording(folder)
    imu_from_cam = recording.calibration.cameras[0].body_from_cam
    np.testing.assert_allclose(imu_from_cam, se3_inverse(euroc_from_imu) @ BODY_FROM_CAM0, atol=1e-12)
    first = recording.ground_truth.frame_from_body[0]
    np.testing.assert_allclose(first, SAMPLE.world_from_body[0] @ euroc_from_imu, atol=1e-9)


def test_right_images_a_little_late_are_paired(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "r", SAMPLE)
    rows = [f"{s + 1_000_000},image{i}.png" for i, s in enumerate(SAMPLE.stamps_ns)]
    (folder / "mav0/cam1/data.csv").write_text("\n".join(rows))
    recording = open_recording(folder)
    np.testing.assert_array_equal(recording.frame_stamps_ns, SAMPLE.stamps_ns)
    assert recording.issues == ()


def test_jpeg_colour_and_16_bits(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "r", SAMPLE)
    images = folder / "mav0/cam0/data"
    cv2.imwrite(str(images / "image0.png"), SAMPLE.left[0].astype(np.uint16) * 256 + 255)
    cv2.imwrite(str(images / "image1.png"), cv2.cvtColor(SAMPLE.left[1], cv2.COLOR_GRAY2BGR))
    recording = open_recording(folder)
    for index in (0, 1):
        np.testing.assert_array_equal(recording.read_frame(index).left, SAMPLE.left[index])


def test_kitti_calibration_and_stamps(tmp_path: Path) -> None:
    recording = open_recording(write_kitti(tmp_path / "r", SAMPLE))
    assert recording.sensor_set is SensorSet.STEREO
    np.testing.assert_array_equal(recording.frame_stamps_ns, 100_000_000 * np.arange(4))
    left, right = recording.calibration.cameras
    np.testing.assert_allclose(left.intrinsics_px, [FOCAL, FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5])
    np.testing.assert_array_equal(left.body_from_cam, np.eye(4))
    np.testing.assert_allclose(right.body_from_cam[:3, 3], [BASELINE_M, 0, 0])
    assert (left.width_px, left.height_px) == (WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("rows", "left"),
    [({0: "x"}, 3), ({2: "1e300 " * 16}, 3), ({1: "0 " * 16}, 3), (dict.fromkeys(range(4), "x"), None)],
    ids=["unreadable", "far away", "no rotation", "none"],
)
def test_a_bad_row_of_kittis_poses_costs_itself(tmp_path: Path, rows: dict[int, str], left: int | None) -> None:
    folder = write_kitti(tmp_path / "r", SAMPLE)
    good = " ".join(map(str, np.eye(4).ravel()))
    (folder / "poses.txt").write_text("\n".join(rows.get(number, good) for number in range(4)))
    recording = open_recording(folder)
    assert (None if recording.ground_truth is None else len(recording.ground_truth)) == left
    assert any("ground truth" in issue.what for issue in recording.issues)


def test_kitti_times_and_unlabelled_rows(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / "r", SAMPLE)
    (folder / "times.txt").write_text("0.0\n1.037e-01\n0.2074\n0.311\n")
    lines = (folder / "calib.txt").read_text().splitlines()[:2]
    (folder / "calib.txt").write_text("\n".join(line.partition(":")[2].strip() for line in lines))
    recording = open_recording(folder)
    np.testing.assert_array_equal(recording.frame_stamps_ns, [0, 103_700_000, 207_400_000, 311_000_000])
    assert recording.calibration.cameras[1].body_from_cam[0, 3] == pytest.approx(BASELINE_M)
    (folder / "calib.txt").write_text("\n".join(["of monday", *lines]))
    with pytest.raises(CalibrationError, match="P0 are not 12 numbers"):
        open_recording(folder)


def test_tumvi_chain_noise_and_16_bits(tmp_path: Path) -> None:
    recording = open_recording(write_tumvi(tmp_path / "r", SAMPLE))
    assert (recording.sensor_set, recording.format) == (SensorSet.STEREO_INERTIAL, "tumvi")
    for ours, wanted in zip(recording.calibration.cameras, calibration().cameras, strict=True):
        np.testing.assert_allclose(ours.body_from_cam, wanted.body_from_cam, atol=1e-12)
    assert recording.calibration.imu == calibration().imu
    np.testing.assert_array_equal(recording.frame_stamps_ns, SAMPLE.stamps_ns)


def test_tumvis_export_in_eurocs_layout(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "r", SAMPLE)
    tumvi = write_tumvi(tmp_path / "t", SAMPLE)
    for file in folder.glob("mav0/*/sensor.yaml"):
        file.unlink()
    (folder / "dso").mkdir()
    shutil.copy(tumvi / "camchain.yaml", folder / "dso")
    shutil.rmtree(folder / "mav0/state_groundtruth_estimate0")
    shutil.copy(tumvi / "gt_imu.csv", folder / "dso")
    recording = open_recording(folder)
    assert recording.sensor_set is SensorSet.STEREO_INERTIAL
    np.testing.assert_allclose(recording.calibration.cameras[0].body_from_cam, BODY_FROM_CAM0, atol=1e-12)
    assert len(recording.ground_truth) == 4


def test_seven_scenes_depth_is_registered_to_colour(tmp_path: Path) -> None:
    """The depth lens is the longer one, 25 mm to the left: all moves towards the middle by 525/585 and left by f * 0.025 / z."""
    folder = write_seven_scenes(tmp_path / "r", SAMPLE)
    recording = open_recording(folder)
    assert recording.sensor_set is SensorSet.RGBD
    assert recording.frame_stamps_ns.tolist() == [round(i * 5 * 1e9 / 30) for i in range(4)]
    depth = recording.read_frame(0).depth_m
    assert set(np.unique(depth)) == {np.float32(0), np.float32(2), np.float32(5)}
    middle = depth[HEIGHT // 2]
    left_2m, left_5m = (525 / 640 * WIDTH * 0.025 / z for z in (2, 5))
    near, far = np.flatnonzero(middle == 2), np.flatnonzero(middle == 5)
    assert near[0] == pytest.approx(WIDTH / 2 * (1 - 525 / 585) - left_2m, abs=1)
    assert near[-1] == pytest.approx(WIDTH / 2 - left_2m, abs=1)
    assert far[0] == pytest.approx(WIDTH / 2 - left_5m, abs=1)
    assert far[-1] == pytest.approx(WIDTH / 2 * (1 + 525 / 585) - left_5m, abs=1)
    # The unknown rows end 100 rows above the centre in the depth image, 100 * 525/585 = 89.7 in the colour image
    known_rows = np.flatnonzero(depth[:, 40] > 0)
    assert known_rows[0] == pytest.approx(HEIGHT / 2 - 100 * 525 / 585, abs=1)
    assert known_rows[-1] == pytest.approx(HEIGHT / 2 + 100 * 525 / 585, abs=1)


def test_seven_scenes_with_a_depth_camera_beside_the_colour_camera(tmp_path: Path) -> None:
    """A point at depth z seen from 50 mm to the right moves by f * 0.05 / z px in the colour image."""
    folder = write_seven_scenes(tmp_path / "r", SAMPLE)
    size = f"resolution: [{WIDTH}, {HEIGHT}], intrinsics: [300, 300, {WIDTH / 2}, {HEIGHT / 2}]"
    lens = f"camera_model: pinhole, distortion_model: none, {size}"
    rows = "[[1, 0, 0, -0.05], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    (tmp_path / "rig.yaml").write_text(f"cam0: {{{lens}}}\ncam1: {{{lens}, T_cn_cnm1: {rows}}}\n")
    recording = open_recording(folder, OpenOptions(calibration_file=tmp_path / "rig.yaml"))
    depth = recording.read_frame(0).depth_m
    near, far = (np.flatnonzero(depth[HEIGHT // 2] == metres) for metres in (2, 5))
    assert near[-1] == pytest.approx(WIDTH // 2 - 1 + 300 * 0.05 / 2, abs=1)
    assert far[0] == near[-1] + 1
    assert far[-1] == WIDTH - 1


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("radial-tangential", (0.1, -0.05, 0.002, -0.001)),
        ("equidistant", (0.03, -0.01, 0.004, -0.001)),
        ("omni", (0.1, -0.05, 0.002, -0.001, 0.7)),
        ("double-sphere", (0.01, 0.0, 0.0, 0.0, -0.2, 0.6)),
        ("eucm", (0.0, 0.0, 0.0, 0.0, 0.6, 1.1)),
    ],
)
def test_depth_lands_where_the_colour_lens_sees_it(model: str, distortion: tuple[float, ...]) -> None:
    intrinsics = np.array([60.0, 61.0, 40.0, 30.0])
    depth_camera = CameraCalibration("radial-tangential", 80, 60, intrinsics, np.zeros(0), np.eye(4))
    shifted = se3(so3_exp(np.array([0.02, -0.03, 0.1])), np.array([0.05, -0.02, 0.01]))
    colour = CameraCalibration(model, 80, 60, intrinsics, np.array(distortion), shifted)
    depth_m = np.zeros((60, 80), np.float32)
    depth_m[12, 60] = 1.5
    registered = DepthRegistration(colour, depth_camera).registered(depth_m, "here")
    ray = depth_camera.ray_from_pixel(np.array([[60.0, 12.0]]))
    point = transform_points(se3_inverse(shifted), 1.5 * ray / ray[:, 2:])
    (u, v), (rows, columns) = np.floor(colour.pixel_from_ray(point)[0]).astype(int), np.nonzero(registered)
    assert {*zip(rows.tolist(), columns.tolist(), strict=True)} == {(v, u), (v, u + 1), (v + 1, u), (v + 1, u + 1)}
    assert registered[rows, columns] == pytest.approx(point[0, 2])


def test_the_real_euroc_camera() -> None:
    camera = read_camera(real_data("euroc_v101_keyframes") / "mav0/cam0/sensor.yaml")
    assert camera.body_from_cam[0, 3] == -0.0216401454975
    assert camera.intrinsics_px.tolist() == [458.654, 457.296, 367.215, 248.375]
