"""What one frame says of its cameras and their mounting: parameters of the images, order of a pair, tilt, heading and height."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.pnp.pnp import Correspondences, refine_pnp
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import Image, WheelSample
from locclient.localization.calibration import mounting
from locclient.localization.calibration.camera_view import CameraView, camera_view
from locclient.localization.calibration.monitor import PairOrder, pair_order
from locclient.localization.calibration.mounting import BasePose, WheelTravel
from locclient.localization.calibration.parameters import FOCAL, IMAGE, PITCH, RIGHT_FOCAL, ROLL, YAW
from support.fleet.estimates import estimate
from support.worlds.pinhole_pair import CAMERA, seen_with


def view_of(parameters: Array, seed: int) -> tuple[CameraView, Array]:
    """The view from where PnP places the camera, as a fix does, and that place's error in metres."""
    matched, map_from_cam, rows = seen_with(parameters, seed)
    found = refine_pnp(matched, se3_inverse(map_from_cam))
    placed = se3_inverse(found.cam_from_source)
    return camera_view(matched, placed, rows), placed[:3, 3] - map_from_cam[:3, 3]


@pytest.mark.parametrize(
    ("parameter", "size"),
    [
        (FOCAL, 0.01),
        (FOCAL, -0.02),
        (1, 0.02),
        (1, -0.05),
        (YAW, 0.002),
        (RIGHT_FOCAL, -0.005),
        (ROLL, 0.004),
        (PITCH, 0.003),
    ],
)
def test_one_wrong_parameter_is_found_and_no_other(parameter: int, size: float) -> None:
    truth = np.zeros(IMAGE)
    truth[parameter] = size
    views = [view_of(truth, seed)[0] for seed in range(12)]
    covariance = np.linalg.inv(sum(view.information for view in views))
    found = covariance @ sum(view.score for view in views)
    sigma = np.sqrt(np.diag(covariance))
    assert abs(size) > 5 * sigma[parameter]
    assert (np.abs(found - truth) < 4 * sigma + 0.03 * abs(size)).all(), (found - truth) / sigma


def test_errors_are_at_most_as_large_as_the_covariance_says() -> None:
    """Robust weights take a third of the information of good points, too."""
    views = [view_of(np.zeros(IMAGE), seed)[0] for seed in range(60)]
    off = [view.score @ np.linalg.solve(view.information, view.score) / IMAGE for view in views]
    assert 0.5 < np.mean(off) < 1.1


def test_the_error_of_the_fix_is_the_one_that_the_view_says() -> None:
    truth = np.zeros(IMAGE)
    truth[FOCAL] = 0.005
    said_m, true_m = [], []
    for seed in range(20):
        _, map_from_cam, _ = seen_with(truth, seed)
        view, error_map_m = view_of(truth, seed)
        said_m.append(-view.pose_per_parameter[3:] @ truth)  # a left perturbation of cam_from_map
        true_m.append(map_from_cam[:3, :3].T @ error_map_m)
    said, true = np.mean(said_m, axis=0), np.mean(true_m, axis=0)
    assert np.linalg.norm(true) > 0.015
    assert np.linalg.norm(said - true) < 0.3 * np.linalg.norm(true)


def test_too_few_depths_say_nothing() -> None:
    matched, map_from_cam, rows = seen_with(np.zeros(IMAGE), 0)
    pixels = matched.pixels.copy()
    pixels[10:, 2] = np.nan
    poor = Correspondences(CAMERA, matched.points_source, pixels, matched.sigmas_px)
    assert camera_view(poor, map_from_cam, rows) is None


COVARIANCE = np.diag([0.001**2] * 3 + [0.005**2] * 3)


def base_at(x_m: float, y_m: float, yaw_rad: float, by_wheels: tuple[float, ...] = (0.0, 0.0, 0.0)) -> BasePose:
    map_from_base = se3(so3_exp(np.array([0, 0, yaw_rad])), np.array([x_m, y_m, 0.0]))
    return BasePose(map_from_base, COVARIANCE, np.array(by_wheels))


def test_a_turned_camera_tilts_gravity_and_a_tilted_map_turns_with_the_robot() -> None:
    turn, map_tilt = np.radians([0.8, -0.5, 0.0]), np.radians([0.2, 0.3, 0.0])
    normal, right_side = np.zeros((4, 4)), np.zeros(4)
    for yaw_rad in np.linspace(0, 5, 12):
        odom_from_body = so3_exp(np.array([0, 0, yaw_rad])) @ so3_exp(np.array([0.03, -0.02, 0.0]))
        map_from_body = so3_exp(map_tilt) @ odom_from_body @ so3_exp(turn)  # as the wrong calibration makes it
        odometry = replace(estimate(0.0).odometry, odom_from_body=se3(odom_from_body, np.zeros(3)), inertial=True)
        fix = Fix(se3(map_from_body, np.zeros(3)), COVARIANCE, 50, 12)
        jacobian, measured = mounting.tilt(fix, np.eye(4), odometry)
        normal += jacobian.T @ jacobian
        right_side += jacobian.T @ measured
    found = np.linalg.solve(normal, right_side)
    assert np.allclose(found, [*turn[:2], *map_tilt[:2]], atol=np.radians(0.03))


def test_a_step_against_the_wheels_shows_a_turned_camera() -> None:
    """Straight, along an arc, along one whose turn the wheels do not tell, and with the turn before the way."""
    error_rad = np.radians(1.0)
    turned = se3(so3_exp(np.array([0, 0, error_rad])), np.zeros(3))
    arc = (np.cos(0.06), np.sin(0.06), 0.12)
    early = (np.cos(0.12), np.sin(0.12), 0.12)
    for way, by_wheels in (((1.0, 0.0, 0.0), (1.0, 0.0, 0.0)), (arc, arc), (arc, (1.0, 0.0, 0.0)), (early, early)):
        before, now = base_at(0, 0, 0.0), base_at(*way, by_wheels)
        believed = [end._replace(map_from_base=end.map_from_base @ turned) for end in (before, now)]
        right = mounting.heading(before, now)
        wrong = mounting.heading(*believed)
        assert abs(right[0]) < 1e-3
        assert abs(wrong[0] - error_rad) < 1e-3
        assert 0.004 < wrong[1] < (0.01 if way[2] == by_wheels[2] else 0.04)


def test_a_turn_that_the_wheels_do_not_tell_may_have_come_at_one_end() -> None:
    for x_m, y_m in ((1.0, 0.0), (np.cos(0.12), np.sin(0.12))):
        found = mounting.heading(base_at(0, 0, 0), base_at(x_m, y_m, 0.12, (1.0, 0.0, 0.0)))
        assert abs(found[0]) < 2 * found[1]


def test_a_step_that_shows_no_direction_says_nothing() -> None:
    assert mounting.heading(base_at(0, 0, 0), base_at(0.1, 0, 0, (0.1, 0, 0))) is None  # short
    assert mounting.heading(base_at(0, 0, 0), base_at(1, 0, 0.5, (1, 0, 0.5))) is None  # a turn
    assert mounting.heading(base_at(0, 0, 0), base_at(1, 0, 0)) is None  # carried
    assert mounting.heading(base_at(0, 0, 0), base_at(1, 0, 0, (np.nan, np.nan, np.nan))) is None  # no wheels then
    assert mounting.heading(base_at(0, 0, 0, (0, 0, np.inf)), base_at(1, 0, 0, (1, 0, np.inf))) is None  # absurd ones


def test_wheels_sum_up_along_their_turns() -> None:
    travel = WheelTravel()
    assert not travel.is_heard
    travel.handle([WheelSample(k * 100_000_000, np.array([1.0, 0.2, 0.0]), 0.0, 0.01, 0.01) for k in range(11)])
    assert travel.is_heard
    assert np.allclose(travel.at(1_000_000_000), [1.0, 0.2, 0.0])
    assert np.allclose(travel.at(250_000_000), [0.25, 0.05, 0.0])  # between two samples
    assert np.isnan(travel.at(1_000_000_001)).all()
    around, speed = WheelTravel(), 0.5 * np.pi
    around.handle([WheelSample(k * 10_000_000, np.array([speed, 0, 0]), speed, 0.01, 0.01) for k in range(101)])
    assert np.allclose(around.at(1_000_000_000), [1.0, 1.0, 0.5 * np.pi], atol=1e-3)
    around.handle([WheelSample(k * 10**10, np.full(3, 1e308), 1e308, 0.01, 0.01) for k in (1, 2, 3)])
    assert not np.isfinite(around.at(3 * 10**10)).any(), "absurd speeds end nothing"


def landmarks(rng: np.random.Generator, on_floor: int) -> Array:
    """Racks around, from the floor up, and so many landmarks on the floor, of which some are reflections below."""
    racks = rng.uniform([-4, -4, 0.1], [4, 4, 3.0], (300, 3))
    floor = np.column_stack([rng.uniform(-4, 4, (on_floor, 2)), rng.normal(0, 0.01, on_floor)])
    return np.vstack([racks, floor, [[0, 1, -0.6], [1, 0, -0.4]]])


def test_the_height_above_the_floor() -> None:
    points = landmarks(np.random.default_rng(0), 60)
    lifted = base_at(0, 0, 0.3)._replace(map_from_base=se3(np.eye(3), np.array([0.0, 0, 0.07])))
    found = mounting.height(lifted, points)
    assert abs(found[0] - 0.07) < 0.015
    assert mounting.height(lifted, landmarks(np.random.default_rng(0), 0)) is None  # no floor to be seen
    assert mounting.height(lifted, np.zeros((0, 3))) is None
    assert np.allclose(se3_inverse(lifted.map_from_base)[2, 3], -0.07)


def pair(disparity_px: int) -> tuple[Image, Image]:
    """Blocks at one distance, by two cameras with noise of their own."""
    rng = np.random.default_rng(3)
    wide = np.kron(rng.integers(20, 230, (60, 90)), np.ones((8, 8))) + rng.normal(0, 6, (480, 720))
    images = (wide[:, 40:680], wide[:, 40 + disparity_px : 680 + disparity_px])
    left, right = (np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image in images)
    return left, right


LEFT, RIGHT = pair(12)
DARK = np.zeros_like(LEFT)
PAIRS: dict[str, tuple[Image, Image | None, PairOrder]] = {
    "good": (LEFT, RIGHT, PairOrder.RIGHT),
    "exchanged": (RIGHT, LEFT, PairOrder.REVERSED),
    "mirrored": (np.fliplr(LEFT).copy(), np.fliplr(RIGHT).copy(), PairOrder.REVERSED),
    "dark": (DARK, DARK, PairOrder.UNKNOWN),
    "far": (*pair(0), PairOrder.UNKNOWN),
    "single": (LEFT, None, PairOrder.UNKNOWN),
}


@pytest.mark.parametrize("what", PAIRS)
def test_the_order_of_a_pair(what: str) -> None:
    left, right, order = PAIRS[what]
    assert pair_order(RectifiedFrame(0, left, right, None), OrbSettings(count=500)) is order
