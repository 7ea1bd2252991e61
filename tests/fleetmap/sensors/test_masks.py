"""Parts of a camera's image that show the robot itself: nothing is found, tracked or expected there."""

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.errors import CalibrationError
from fleetmap.features.extraction import extract
from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.features.settings import OrbSettings, StereoSettings
from fleetmap.geometry import se3_inverse
from fleetmap.odometry.mono.mono_modes import make_odometry
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.pnp.pnp import REFINEMENT
from fleetmap.recordings.calibration_files import format_calibration, parse_calibration, read_calibration
from fleetmap.relocalization.settings import FixSettings
from fleetmap.sensors.calibration import Polygon, RigCalibration, hidden_pixels
from fleetmap.sensors.lens_fit import follow_points
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from mapserver.doctor.camera_motion import motion_between
from support.worlds.inertial_motion import moved_between
from support.worlds.textured_room import BODY_FROM_CAM, CAMERA, FRAME_NS, rig, stereo_frame

SIZE_PX = CAMERA.width_px, CAMERA.height_px
BODY: Polygon = ((0.0, 110.0), (210.0, 110.0), (319.0, 150.0), (319.0, 199.0), (0.0, 199.0))


def masked(mask: tuple[Polygon, ...] = (BODY,)) -> RigCalibration:
    return replace(rig(None), cameras=tuple(replace(camera, mask=mask) for camera in rig(None).cameras))


def frame_with_body(stamp_ns: int) -> CameraFrame:
    """The room as a robot sees it whose own body, with screws and stickers, fills the same pixels of every image."""
    paint = np.random.default_rng(7).integers(0, 255, (CAMERA.height_px, CAMERA.width_px)).astype(np.uint8)
    paint = cv2.normalize(cv2.GaussianBlur(paint, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    seen, shown = stereo_frame(stamp_ns), hidden_pixels((BODY,), SIZE_PX)
    left, right = (np.where(shown, paint, image).astype(np.uint8) for image in (seen.left, seen.right))
    return CameraFrame(stamp_ns, left, right)


def drift_m(calibration: RigCalibration) -> float:
    """Error of the distance covered in two seconds."""
    rectifier = Rectifier(calibration)
    odometry = make_odometry(rectifier.rig, OdometrySettings())
    frames = (rectifier.rectify(frame_with_body(k * FRAME_NS)) for k in range(1, 40))
    placed = [odometry.handle_stereo(frame).odom_from_body for frame in frames]
    moved = se3_inverse(placed[0]) @ placed[-1]
    return float(np.linalg.norm((moved - moved_between(FRAME_NS * 1e-9, 39 * FRAME_NS * 1e-9))[:3, 3]))


def test_odometry_does_not_follow_the_robots_own_body() -> None:
    assert drift_m(masked()) < 0.05 < 5 * 0.05 < drift_m(rig(None))


def test_no_descriptor_and_no_corner_touches_the_body() -> None:
    rectifier = Rectifier(masked())
    frame, clearance_px = rectifier.rectify(frame_with_body(FRAME_NS)), rectifier.camera.clearance_px
    features, everywhere = (extract(frame.left, OrbSettings(count=300), each) for each in (clearance_px, None))
    room_px = clearance_px[tuple(np.rint(features.pixels).astype(int).T[::-1])]
    assert (room_px > 14.0 * SCALE_FACTOR**features.octaves).all()
    assert len(features) > 0.5 * len(everywhere)
    none = np.zeros((0, 2), np.float32)
    tracker, _ = core.spread_corners(frame.left, 100, 8.0, 12, 8, none, clearance_px, 1.0, 5.0)
    assert (clearance_px[tuple(np.rint(tracker).astype(int).T[::-1])] > 5).all() and len(tracker) > 20


def test_points_end_at_the_body() -> None:
    """A point that the flow carries into the window around the body ends; the same point goes on without a mask."""
    rectifier = Rectifier(masked())
    odometry = make_odometry(rectifier.rig, OdometrySettings())
    clearance_px = rectifier.camera.clearance_px
    for k in range(1, 20):
        estimate = odometry.handle_stereo(rectifier.rectify(frame_with_body(k * FRAME_NS)))
        at = np.rint(estimate.track_pixels[:, :2]).astype(int).T[::-1]
        assert (clearance_px[tuple(at)] > 5).all()


def test_checks_of_a_recording_look_beside_the_body() -> None:
    frames = [frame_with_body(k * FRAME_NS) for k in (1, 4)]
    points = follow_points(*frames, masked().cameras[0].mask)
    assert not hidden_pixels((BODY,), SIZE_PX)[tuple(np.rint(points.left).astype(int).T[::-1])].any()
    rectifier = Rectifier(masked())
    found, _ = motion_between(*(rectifier.rectify(frame) for frame in frames), rectifier.camera)  # type: ignore[misc]
    true = se3_inverse(BODY_FROM_CAM) @ moved_between(FRAME_NS * 1e-9, 4 * FRAME_NS * 1e-9) @ BODY_FROM_CAM
    assert np.linalg.norm((found - true)[:3, 3]) < 0.02


def test_a_masked_pixel_becomes_black_and_nothing_else_changes() -> None:
    rectifier, plain = Rectifier(masked()), Rectifier(rig(None))
    frame = frame_with_body(FRAME_NS)
    hidden = hidden_pixels((BODY,), SIZE_PX)
    ours, other = rectifier.rectify(frame), plain.rectify(frame)
    for one, same in ((ours.left, other.left), (ours.right, other.right)):
        assert not one[hidden].any()
        beside = np.abs(one[~hidden].astype(int) - same[~hidden])
        assert np.quantile(beside, 0.98) <= 1
    assert plain.camera.clearance_px is None and rectifier.camera == plain.camera
    depth = np.full(hidden.shape, 2.0, np.float32)
    single = Rectifier(RigCalibration(masked().cameras[:1]), has_depth=True)
    disparity = single.rectify(CameraFrame(FRAME_NS, frame.left, depth_m=depth)).disparity_px
    assert np.array_equal(np.isnan(disparity), hidden)


def test_landmarks_behind_the_body_are_not_missed() -> None:
    """Half of the landmarks lie behind the robot's own body: the fix expects the other half alone."""

    rng, camera = np.random.default_rng(3), Rectifier(masked()).camera
    count = 200
    at = np.column_stack([rng.uniform(20, 300, count), rng.uniform(20, 180, count)])
    points = camera.point_from_pixel(at, rng.uniform(4, 10, count))
    distances = np.linalg.norm(points, axis=1)
    away = (-points / distances[:, None]).astype(np.float32)
    reach, words = distances.astype(np.float32), rng.integers(0, 2**63, (count, 4)).astype(np.uint64)
    pixels = camera.pixel_from_point(points)
    shown = camera.clearance_px[tuple(np.rint(at).astype(int).T[::-1])] > 15
    seen = pixels[shown], pixels[shown, :2].copy(), np.zeros(shown.sum(), np.int8), words[shown]

    def expected(clearance_px: NDArray[np.uint8] | None) -> tuple[int, int]:
        finder = core.FixFinder(
            *((points, away, np.full(count, 0.3, np.float32), reach), np.full(count, 0.01, np.float32), words),
            *(np.eye(4)[None], np.arange(count), np.array([0, count]), np.array([*camera.lens, *SIZE_PX], np.float64)),
            *(1.0, SCALE_FACTOR, FixSettings(), StereoSettings(), 0.35, REFINEMENT, clearance_px),
        )
        found = finder.by_projection(seen, None, np.eye(4), 12.0)
        return len(found[8]), int(found[9].sum())

    (all_of_them, found), (beside, same) = expected(None), expected(camera.clearance_px)
    assert found == same and all_of_them == count
    assert shown.sum() * 0.3 < beside <= shown.sum()


# --------------------------------------------------------------------------------------------------------------- files


def test_masks_are_written_and_read_back_bit_for_bit() -> None:
    hole: Polygon = ((20.5, 130.25), (40.0, 130.0), (40.0, 150.0))
    ours = masked((BODY, hole))
    back = parse_calibration(format_calibration(ours), "text").calibration
    assert [camera.mask for camera in back.cameras] == [(BODY, hole)] * 2
    assert "mask" not in format_calibration(rig(None))
    shown = hidden_pixels((BODY, hole), SIZE_PX)
    assert shown[180, 10] and not shown[140, 36] and not shown[20, 20]


def test_a_mask_of_an_image_has_its_holes(tmp_path: Path) -> None:
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    picture = np.where(np.hypot(u - 160, v - 100) > 90, 255, 0).astype(np.uint8)  # the rim of a fisheye
    picture[150:, 100:180] = 1
    cv2.imwrite(str(tmp_path / "robot.png"), picture)
    (tmp_path / "camchain.yaml").write_text(camchain("robot.png"))
    read = read_calibration(tmp_path / "camchain.yaml").cameras[0]
    differs = hidden_pixels(read.mask, SIZE_PX) != (picture > 0)
    edges = cv2.morphologyEx((picture > 0).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) > 0
    assert not differs[~edges].any() and differs.mean() < 0.01


def camchain(mask: object, cameras: int = 1) -> str:
    first = rig(None).cameras[0]
    text = format_calibration(RigCalibration((first,) * cameras))
    return text.replace("  T_cam_imu:", f"  mask: {mask}\n  T_cam_imu:")


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        ([[[400, 10], [500, 10], [500, 90]]], "outside of the 320x200 image"),
        ([[[-90, 10], [-5, 10], [-5, 90]]], "outside of the 320x200 image"),
        ([[[-1, -1], [320, -1], [320, 200], [-1, 200]]], "hides the whole image"),
        ([[[0, 0], [1, 0]]], "three corners or more"),
        ([[[0, 0], [1, 0], [float("inf"), 1]]], "near the image"),
        ([[[u, u % 2] for u in range(1200)]], "1200 corners"),
        ("white.png", "hides the whole image"),
        ("missing.png", "missing.png is not there"),
        ("noise.png", "noise.png has .* areas; the limit is 333"),
        ("pipe", "pipe is not there, no file"),
        (".", "is not there, no file"),
        ("small.png", "small.png is 32x20"),
        ("bomb.png", "bomb.png cannot be read"),
        ("../white.png", "not a file beside the calibration"),
        ("/etc/hostname", "not a file beside the calibration"),
        ("[[0, 0], [1, 1]]", "write polygons"),
        ("7", "write polygons"),
    ],
)
def test_a_mask_that_cannot_be_meant_is_refused(tmp_path: Path, mask: object, words: str) -> None:
    for name, size_px in (("white", SIZE_PX), ("small", (32, 20))):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full(size_px[::-1], 255, np.uint8))
    head = bytearray((tmp_path / "small.png").read_bytes())
    head[16:24] = (30_000).to_bytes(4, "big") * 2
    (tmp_path / "bomb.png").write_bytes(head)
    noise = np.random.default_rng(0).integers(0, 2, SIZE_PX[::-1], np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "cams.yaml").write_text(camchain(mask))
    with pytest.raises(CalibrationError, match=words):
        read_calibration(tmp_path / "cams.yaml")
    with pytest.raises(CalibrationError, match="mask"):  # a recording's own names no file
        parse_calibration(camchain(mask), "text")


@pytest.mark.parametrize("kind", ["16 bits", "blue"])
def test_every_value_but_0_hides_also_thin_lines(tmp_path: Path, kind: str) -> None:
    """A cable of two pixels, an aerial of one, and a spot; in the least value of 16 bits, or of one colour."""
    shown = np.zeros((CAMERA.height_px, CAMERA.width_px), bool)
    shown[20:180, 40:42] = shown[30:150, 90] = shown[100, 200] = True
    image = shown.astype(np.uint16) if kind == "16 bits" else np.dstack([shown, 0 * shown, 0 * shown]).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "robot.png"), image)
    (tmp_path / "cams.yaml").write_text(camchain("robot.png"))
    mask = read_calibration(tmp_path / "cams.yaml").cameras[0].mask
    np.testing.assert_array_equal(hidden_pixels(mask, SIZE_PX), shown)


def test_masks_of_many_cameras_are_read_as_they_were_written() -> None:
    corners = [[float(u), float(100 + u % 7)] for u in range(300)] * 3
    found = parse_calibration(camchain([corners], cameras=16), "x").calibration
    assert parse_calibration(format_calibration(found), "y").calibration.cameras[15].mask == found.cameras[15].mask
