"""A wrong lens is named, by points that another implementation of the lens (OpenCV's) projects; a right one is not doubted."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, transform_points
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.lens_fit import FollowedPoints, fit_lens

LENSES = {
    "radial-tangential": np.array([-0.28, 0.07, 2e-4, 2e-4]),
    "equidistant": np.array([-0.013, 0.02, -0.015, 0.004]),
}
FOCAL_PX = 380.0
CAM0_FROM_CAM1 = se3(np.eye(3), np.array([0.12, 0.0, 0.0]))


def rig(model: str, factor: float = 1.0, distortion: Array | None = None, *, whole: float = 1.0) -> RigCalibration:
    intrinsics = np.array([factor * FOCAL_PX, factor * FOCAL_PX, 319.5, 239.5]) * whole
    lens = LENSES[model] if distortion is None else distortion
    camera = CameraCalibration(model, 640, 480, intrinsics, lens, np.eye(4))
    return RigCalibration((camera, replace(camera, body_from_cam=CAM0_FROM_CAM1)))


def seen(model: str, points_cam: Array, rng: np.random.Generator) -> Array:
    """(N, 2) pixels by OpenCV, with noise; NaN outside the image."""
    matrix = np.array([[FOCAL_PX, 0, 319.5], [0, FOCAL_PX, 239.5], [0, 0, 1]])
    project = cv2.projectPoints if model == "radial-tangential" else cv2.fisheye.projectPoints
    given = (points_cam[:, None], np.zeros(3), np.zeros(3), matrix, LENSES[model])
    pixels = project(*given)[0].reshape(-1, 2)
    pixels = pixels + rng.normal(0, 0.15, pixels.shape)
    pixels[(pixels < 0).any(axis=1) | (pixels > [639, 479]).any(axis=1)] = np.nan
    return np.asarray(pixels)


def followed(model: str, *, turns: bool, has_depth: bool = False) -> list[FollowedPoints]:
    """Eight pairs of frames of a drive past points 1 to 8 m away, straight or in curves."""
    rng = np.random.default_rng(5)
    pairs = []
    for number in range(8):
        depth_m = rng.uniform(1.0, 8.0, 180)
        points = np.column_stack([rng.uniform(-0.8, 0.8, (180, 2)) * [1.0, 0.75] * depth_m[:, None], depth_m])
        turn = so3_exp(np.array([0.0, (0.2 if number % 2 else -0.15) * turns, 0.0]))
        later = transform_points(se3_inverse(se3(turn, np.array([0.02, 0.0, 0.25]))), points)
        left, second = seen(model, points, rng), seen(model, later, rng)
        right = seen(model, transform_points(se3_inverse(CAM0_FROM_CAM1), points), rng)
        good = np.isfinite(np.hstack([left, right, second])).all(axis=1)
        depths = (None, depth_m[good]) if has_depth else (right[good], None)
        pairs.append(FollowedPoints(left[good], *depths, second[good]))
    return pairs


@pytest.mark.parametrize("has_depth", [False, True])
@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("model", list(LENSES))
def test_the_right_lens_is_not_doubted(model: str, turns: bool, has_depth: bool) -> None:
    fit = fit_lens(rig(model), followed(model, turns=turns, has_depth=has_depth))
    assert not fit.is_doubtful, fit


@pytest.mark.parametrize(
    ("model", "given", "turns", "says"),
    [
        ("equidistant", rig("radial-tangential", distortion=LENSES["equidistant"]), False, "equidistant"),
        ("radial-tangential", rig("equidistant", distortion=LENSES["radial-tangential"]), False, "plumb_bob"),
        ("radial-tangential", rig("radial-tangential", distortion=np.zeros(0)), False, "equidistant"),
        ("radial-tangential", rig("radial-tangential", 0.7), False, "1.43 times"),
        ("radial-tangential", rig("radial-tangential", 1.3), True, "0.77 times"),
        ("equidistant", rig("equidistant", 0.7), True, "1.43 times"),
        ("equidistant", rig("equidistant", 1.3), True, "0.77 times"),
        ("equidistant", rig("equidistant", whole=0.5), False, "times 2: it is of images of half the size"),
        ("equidistant", rig("equidistant", whole=1.9), True, "times 0.5: it is of images of twice the size"),
    ],
)
def test_a_wrong_lens_is_named(model: str, given: RigCalibration, turns: bool, says: str) -> None:
    fit = fit_lens(given, followed(model, turns=turns))
    assert fit.ratio > 2.5
    words = fit.words(given.cameras[0])
    assert says in words
    assert f"fx {given.cameras[0].intrinsics_px[0]:.1f} px at 640x480" in words
    assert "--calibration FILE" in words


@pytest.mark.parametrize("factor", [1.0, 0.7])
def test_a_fisheye_that_sees_190_degrees(factor: float) -> None:
    """Points beside and behind the camera lie on no plane z = 1: they neither doubt the right lens nor hide a wrong one."""
    rng, shape = np.random.default_rng(7), np.array([0.0, 0.0, 0.0, 0.0, -0.17, 0.59])

    def fisheye(focal_px: float) -> RigCalibration:
        intrinsics = np.array([focal_px, focal_px, 255.5, 255.5])
        left = CameraCalibration("double-sphere", 512, 512, intrinsics, shape, np.eye(4))
        return RigCalibration((left, replace(left, body_from_cam=CAM0_FROM_CAM1)))

    true, pairs = fisheye(155.0), []
    for number in range(8):
        angle, around, away_m = rng.uniform([0.1, 0.0, 1.0], [1.65, 6.28, 8.0], (250, 3)).T
        rays = np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
        points, turn = away_m[:, None] * rays, so3_exp(np.array([0.0, 0.2 if number % 2 else -0.15, 0.0]))
        later = transform_points(se3_inverse(se3(turn, np.array([0.02, 0.0, 0.25]))), points)
        seen_px = [
            true.cameras[0].pixel_from_ray(each) + rng.normal(0, 0.15, (250, 2))
            for each in (points, transform_points(se3_inverse(CAM0_FROM_CAM1), points), later)
        ]
        good = ((np.array(seen_px) > 0) & (np.array(seen_px) < 511)).all(axis=(0, 2))
        pairs.append(FollowedPoints(seen_px[0][good], seen_px[1][good], None, seen_px[2][good]))
    fit = fit_lens(fisheye(factor * 155.0), pairs)
    assert fit.is_doubtful == (factor != 1.0)


def test_nothing_is_said_of_a_camera_at_rest() -> None:
    pairs = [replace(points, later=points.left) for points in followed("equidistant", turns=False)]
    assert fit_lens(rig("radial-tangential"), pairs) is None
    assert fit_lens(rig("radial-tangential"), []) is None
