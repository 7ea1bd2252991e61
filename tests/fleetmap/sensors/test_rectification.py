"""Rectified pairs against the lens models: dots painted where a lens sees a point must appear where the pinhole says."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fleetmap import core
from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp, transform_points
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.rectification import RGBD_BASELINE_M, Rectifier, StereoCamera
from fleetmap.sensors.samples import CameraFrame, Image
from support.recordings.recording_samples import calibration as sample_calibration

WIDTH, HEIGHT = 320, 240
BODY_FROM_CAM0 = se3_exp(np.array([-1.2, 1.2, -1.2, 0.05, 0.02, 0.01]))
LENSES = {
    "radial-tangential": np.array([-0.28, 0.08, 2e-4, -1e-4]),
    "equidistant": np.array([-0.01, 0.02, -0.01, 0.002]),
    "double-sphere": np.array([0.0, 0.0, 0.0, 0.0, -0.2, 0.6]),
    "omni": np.array([-0.1, 0.02, 2e-4, -1e-4, 0.8]),
}


APART = se3(so3_exp(np.array([0.02, -0.03, 0.015])), np.array([0.11, 0.004, -0.003]))


def rig(model: str, cam0_from_cam1: Array = APART) -> RigCalibration:
    """Two unlike cameras, turned against each other by 2 degrees, 0.11 m apart and not quite side by side."""
    pinholes, lens = np.array([[200.0, 201.0, 158.0, 122.0], [205.0, 204.0, 163.0, 117.0]]), LENSES[model]
    left = CameraCalibration(model, WIDTH, HEIGHT, pinholes[0], lens, BODY_FROM_CAM0)
    right = CameraCalibration(model, WIDTH, HEIGHT, pinholes[1], 0.9 * lens, BODY_FROM_CAM0 @ cam0_from_cam1)
    return RigCalibration((left, right))


def points_in_view(rng: np.random.Generator, count: int) -> Array:
    depth = rng.uniform(1.0, 8.0, count)
    sideways = rng.uniform(-0.45, 0.45, (count, 2)) * [1.0, 0.8] * depth[:, None]
    return np.column_stack([sideways, depth])


UV = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1)


def dot(pixel: Array) -> Image:
    return np.rint(250 * np.exp(-((UV - pixel) ** 2).sum(axis=-1) / (2 * 1.5**2))).astype(np.uint8)


def centre(image: Image) -> Array:
    return (UV * image[..., None].astype(float)).sum(axis=(0, 1)) / image.sum()


@pytest.mark.parametrize("model", LENSES)
def test_dots_appear_where_the_rectified_pair_says(model: str) -> None:
    """Through the pictures, as exactly as a remap in steps of 1/32 px can: unbiased, and on the same row left and right."""
    calibration = rig(model)
    rectifier = Rectifier(calibration)
    errors = []
    for point in points_in_view(np.random.default_rng(1), 30):
        point_body = transform_points(rectifier.body_from_cam, point[None])
        rays = (transform_points(se3_inverse(camera.body_from_cam), point_body) for camera in calibration.cameras)
        seen = (camera.pixel_from_ray(ray)[0] for camera, ray in zip(calibration.cameras, rays, strict=True))
        frame = rectifier.rectify(CameraFrame(0, *map(dot, seen)))
        expected = rectifier.camera.pixel_from_point(point[None])[0]
        errors.append([*(centre(frame.left) - expected[:2]), *(centre(frame.right) - expected[[2, 1]])])
    assert np.abs(errors).max() < 0.07
    assert np.abs(np.mean(errors, axis=0)).max() < 0.01
    assert abs(np.mean(np.array(errors)[:, 1] - np.array(errors)[:, 3])) < 0.01


@pytest.mark.parametrize("size_px", [(480, 752), (37, 53), (5, 6)])
@pytest.mark.parametrize("bend_px", [0.5, 8.0, 60.0], ids=lambda px: f"bent by {px} px")
def test_pictures_are_resampled_as_opencv_does(size_px: tuple[int, int], bend_px: float) -> None:
    rng = np.random.default_rng(1)
    v, u = np.indices(size_px, np.float32)
    at = u + bend_px * np.sin(v / 50) + rng.normal(0.0, 0.05, size_px), 0.9 * v + bend_px * np.cos(u / 70)
    tables = cv2.convertMaps(*(each.astype(np.float32) for each in at), cv2.CV_16SC2)
    height, width = size_px[0] - 1, size_px[1] + 3
    picture = rng.integers(0, 256, (height, width)).astype(np.uint8)
    made = core.Remap(*tables, height, width).resample(picture)  # type: ignore[arg-type]
    np.testing.assert_array_equal(made, cv2.remap(picture, *tables, cv2.INTER_LINEAR))


def test_points_come_back_from_pixel_and_disparity() -> None:
    camera = Rectifier(rig("radial-tangential")).camera
    points = points_in_view(np.random.default_rng(3), 50)
    pixels = camera.pixel_from_point(points)
    np.testing.assert_allclose(camera.point_from_pixel(pixels[:, :2], pixels[:, 0] - pixels[:, 2]), points, atol=1e-9)
    np.testing.assert_allclose((points @ camera.matrix.T)[:, :2] / points[:, 2:], pixels[:, :2], atol=1e-9)
    assert np.isnan(camera.pixel_from_point(np.array([[0.0, 0.0, -1.0]]))).all()
    assert not np.isfinite(camera.point_from_pixel(np.array([[3.0, 4.0]]), np.zeros(1))).any()


def test_a_rig_that_is_rectified_already_keeps_its_pictures() -> None:
    lens = np.array([200.0, 200, 160, 120]), np.zeros(4)
    pinhole = CameraCalibration("radial-tangential", WIDTH, HEIGHT, *lens, np.eye(4))
    second = replace(pinhole, body_from_cam=se3(np.eye(3), np.array([0.5, 0, 0])))
    rectifier = Rectifier(RigCalibration((pinhole, second)))
    left, right = dot(np.array([100.0, 50.0])), dot(np.array([80.0, 50.0]))
    frame = rectifier.rectify(CameraFrame(7, left, right))
    assert (frame.left is left, frame.right is right, frame.stamp_ns) == (True, True, 7)
    np.testing.assert_array_equal(rectifier.body_from_cam, np.eye(4))


def test_a_single_camera_has_no_baseline_and_depth_becomes_disparity_where_it_is_known() -> None:
    rectifier = Rectifier(RigCalibration(rig("equidistant").cameras[:1]))
    assert rectifier.camera.baseline_m == 0
    assert rectifier.rectify(CameraFrame(0, dot(np.array([10.0, 10.0])))).right is None
    rectifier = Rectifier(RigCalibration(rig("radial-tangential").cameras[:1]), has_depth=True)
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth[:, 200:] = 0.0
    frame = rectifier.rectify(CameraFrame(0, dot(np.array([10.0, 10.0])), None, depth))
    assert frame.disparity_px[120, 100] == pytest.approx(rectifier.camera.focal_px * RGBD_BASELINE_M / 2.0)
    assert np.isnan(frame.disparity_px[120, 280])


@pytest.mark.parametrize(
    ("calibration", "says"),
    [
        (RigCalibration(rig("equidistant").cameras[::-1]), "swapped"),
        (rig("equidistant", cam0_from_cam1=np.eye(4)), "baseline"),
        (RigCalibration(()), "--calibration"),
    ],
)
def test_rigs_that_cannot_be_rectified_are_refused(calibration: RigCalibration, says: str) -> None:
    with pytest.raises(CalibrationError, match=says):
        Rectifier(calibration)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_picture_of_another_size_is_refused(side: str) -> None:
    rectifier = Rectifier(rig("radial-tangential"))
    good, small = np.zeros((HEIGHT, WIDTH), np.uint8), np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)
    frame = CameraFrame(123, small, good) if side == "left" else CameraFrame(123, good, small)
    with pytest.raises(RecordingError, match=r"at 123 is 160x120.*320x240"):
        rectifier.rectify(frame)


def test_a_rig_is_seen_through_the_pinhole_that_is_asked_for() -> None:
    """A picture whose grey is its column: through another pinhole each pixel shows the column that its ray came from."""
    straight = sample_calibration()
    own = Rectifier(straight).camera
    pinhole = StereoCamera(1.25 * own.focal_px, own.cx_px + 7.0, own.cy_px - 3.0, 0.9, own.width_px - 40, own.height_px)
    rectifier = Rectifier(straight, pinhole=pinhole)
    assert rectifier.camera == replace(pinhole, baseline_m=own.baseline_m)
    columns = np.tile(np.arange(own.width_px) % 200, (own.height_px, 1)).astype(np.uint8)
    seen = rectifier.rectify(CameraFrame(1, columns, columns)).left
    assert seen.shape == (pinhole.height_px, pinhole.width_px)
    x = np.arange(60, 200)
    wanted = own.cx_px + (x - pinhole.cx_px) / 1.25
    np.testing.assert_allclose(seen[100, x], wanted, atol=1.0)
    for factor in (0.5, 2.0):
        with pytest.raises(CalibrationError, match="focal length"):
            Rectifier(straight, pinhole=replace(own, focal_px=factor * own.focal_px))
