"""One camera's geometry on points: two views, the window's adjustment, and the way along a known motion up to its scale."""

import numpy as np
import pytest

from fleetmap import core
from fleetmap.geometry import Array, align_points, rotation_angle_rad, se3, se3_inverse, so3_exp, transform_points
from fleetmap.odometry.mono.mono_vo import VisualOdometry
from fleetmap.odometry.mono.two_view import TwoView, two_view_motion
from fleetmap.odometry.settings import MonocularSettings
from fleetmap.sensors.rectification import StereoCamera

CAMERA = StereoCamera(400.0, 320.0, 240.0, 0.0, 640, 480)
B_FROM_A = se3(so3_exp(np.array([0.02, -0.08, 0.03])), np.array([-0.8, 0.1, 0.25]))


def cloud(rng: np.random.Generator, count: int, depth: tuple[float, float] = (3.0, 9.0)) -> Array:
    z = rng.uniform(*depth, count)
    return np.column_stack([z * rng.uniform(-0.7, 0.7, count), z * rng.uniform(-0.5, 0.5, count), z])


def seen(points: Array, cam_from_map: Array, rng: np.random.Generator, sigma_px: float) -> Array:
    pixels = CAMERA.pixel_from_point(transform_points(cam_from_map, points))[:, :2]
    return np.asarray(pixels + sigma_px * rng.normal(size=pixels.shape))


def two_views(rng: np.random.Generator, points: Array, b_from_a: Array, sigma_px: float) -> TwoView | None:
    a, b = seen(points, np.eye(4), rng, sigma_px), seen(points, b_from_a, rng, sigma_px)
    return two_view_motion(CAMERA, a, b, seed=1)


def test_two_views_give_direction_and_rotation() -> None:
    """With a quarter of the matches wrong."""
    rng = np.random.default_rng(4)
    points = cloud(rng, 200)
    a, b = seen(points, np.eye(4), rng, 0.3), seen(points, B_FROM_A, rng, 0.3)
    b[::4] = rng.uniform([0, 0], [640, 480], (50, 2))
    found = two_view_motion(CAMERA, a, b, seed=1)
    assert is_right(found.b_from_a)
    right = np.ones(200, bool)
    right[::4] = False
    assert found.inliers[right].mean() > 0.9
    assert found.inliers[~right].mean() < 0.2


def is_right(b_from_a: Array) -> bool:
    direction = B_FROM_A[:3, 3] / np.linalg.norm(B_FROM_A[:3, 3])
    turn = rotation_angle_rad(b_from_a[:3, :3] @ B_FROM_A[:3, :3].T)
    return bool(turn < np.radians(1.5) and b_from_a[:3, 3] @ direction > np.cos(np.radians(8.0)))


@pytest.mark.parametrize("slope", [0.0, 0.4, 1.0])
def test_a_flat_scene_gives_the_truth_or_nothing(slope: float) -> None:
    """Two motions can explain two views of one plane equally well: then there is no answer, never the wrong one."""
    rng = np.random.default_rng(4)
    points = cloud(rng, 200)
    plane = 5.0 / (1.0 - slope * points[:, 0] / points[:, 2])
    points *= (plane / points[:, 2])[:, None]
    found = two_views(rng, points, B_FROM_A, 0.3)
    assert found is None or is_right(found.b_from_a)


def test_a_turn_on_the_spot_is_no_motion() -> None:
    """Nothing can be placed without parallax: the rays stay parallel."""
    rng = np.random.default_rng(5)
    found = two_views(rng, cloud(rng, 200), se3(so3_exp(np.array([0.0, 0.15, 0.0])), np.zeros(3)), 0.2)
    assert found is None or found.parallax_rad < np.radians(0.5)


def test_the_window_finds_the_truth_and_leaves_what_is_held() -> None:
    rng = np.random.default_rng(7)
    points = cloud(rng, 80)
    way = np.arange(6.0)[:, None] * [0.0, 0.02, 0.01, 0.15, 0.02, 0.05]
    truth = [se3(so3_exp(step[:3]), step[3:]) for step in way]
    starts, views = 6 * np.arange(81), np.tile(np.arange(6), 80)
    each = np.array([seen(points, se3_inverse(t), rng, 0.0) for t in truth])  # (6, 80, 2)
    observed = starts, views, np.ascontiguousarray(each.transpose(1, 0, 2).reshape(-1, 2)), CAMERA.lens, 0.5, 2.5
    moved = np.array(truth)
    for there in moved[2:]:
        there[:3, :3] = so3_exp(0.02 * rng.normal(size=3)) @ there[:3, :3]
        there[:3, 3] += 0.05 * rng.normal(size=3)
    moved_points = points + 0.1 * rng.normal(size=points.shape)
    *_, before = core.adjust_window(moved, 2, moved_points, *observed, 0)
    # seven steps are enough only with right derivatives
    found, found_points, squared, after = core.adjust_window(moved, 2, moved_points, *observed, 7)
    assert before > 1e3
    assert after < 1e-6
    assert squared.sum() == pytest.approx(2.0 * after)
    assert found == pytest.approx(np.array(truth), abs=1e-4)
    assert found_points == pytest.approx(points, abs=1e-3)
    assert (found[:2] == moved[:2]).all()


def test_the_way_along_a_wall_is_right_up_to_scale() -> None:
    """60 frames along 6 m of points, tracks that come and go: shape to 1 % of the way, scale by the first scene's depth."""
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(-4, 11, 1500), rng.uniform(-2.5, 2.5, 1500), rng.uniform(4, 8, 1500)])
    odometry = VisualOdometry(CAMERA, MonocularSettings())
    truth, found = [], {}
    for k in range(60):
        place = np.array([0.1 * k, 0.1 * np.sin(0.15 * k), 0.02 * k])
        map_from_cam = se3(so3_exp(np.array([0.0, 0.004 * k, 0.0])), place)
        truth.append(map_from_cam[:3, 3])
        pixels = seen(points, se3_inverse(map_from_cam), rng, 0.2)
        with np.errstate(invalid="ignore"):
            inside = (pixels > 5).all(axis=1) & (pixels[:, 0] < 635) & (pixels[:, 1] < 475)
        ids = np.flatnonzero(inside & (np.arange(1500) % 4 == 0))
        sight = odometry.add(k, ids, pixels[ids])
        assert not sight.lost
        for number, there in sight.revised:
            found[number] = there[:3, 3]
        if sight.vision_from_cam is not None:
            found[k] = sight.vision_from_cam[:3, 3]
    assert sorted(found) == list(range(60))
    estimated, true = np.array([found[k] for k in range(60)]), np.array(truth)
    placed, scale = align_points(true, estimated, with_scale=True)
    errors = np.linalg.norm(transform_points(placed, scale * estimated) - true, axis=1)
    assert errors.max() < 0.06
    assert scale == pytest.approx(6.0 / 5.0, rel=0.15)  # the wall's median depth over the unit


def test_what_was_lost_begins_again() -> None:
    rng = np.random.default_rng(9)
    points = np.column_stack([rng.uniform(-4, 8, 800), rng.uniform(-2.5, 2.5, 800), rng.uniform(4, 8, 800)])
    odometry = VisualOdometry(CAMERA, MonocularSettings())
    lost = []
    for k in range(30):
        offset = 0 if k < 15 else 10_000  # other tracks altogether
        map_from_cam = se3(np.eye(3), np.array([0.1 * k, 0.0, 0.0]))
        ids = np.arange(0, 800, 4)
        sight = odometry.add(k, ids + offset, seen(points[ids], se3_inverse(map_from_cam), rng, 0.2))
        lost.append(sight.lost)
    assert [k for k, was in enumerate(lost) if was] == [15]
    assert sight.vision_from_cam is not None
