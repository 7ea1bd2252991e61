"""The protection level: its definition, no errors beyond it under faults, and what must fail without one of its parts."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.stats import chi

from benchmarks.robot.bench_protection import FAULTS, MAP_SIGMAS, RISK, Drive, drive_of, judged
from fleetmap import core
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, transform_points
from fleetmap.mapformat.map_errors import ErrorSigmas, MapErrors
from fleetmap.messages import Status
from fleetmap.pnp.pnp import REFINEMENT, Correspondences
from fleetmap.relocalization.map_view import LookAlikes
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.rectification import StereoCamera
from locclient.localization.calibration.watch import CalibrationWatch
from locclient.localization.place import Place, boxminus, boxplus
from locclient.localization.protection import middle_of
from support.fleet.scripted_robot import NO_FIX, Robot, off

CAMERA = StereoCamera(400.0, 320.0, 240.0, 0.12, 640, 480)
BODY_FROM_CAM = se3(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.2, 0.06, 0.5]))


def aisle(frames: int = 60, matches: int = 80) -> Drive:
    """A drive of half a metre a fix between two racks."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(0, 45, 6000), rng.choice([-1.6, 1.6], 6000), rng.uniform(0.1, 4, 6000)])
    turns = [so3_exp(np.array([0, 0, 0.1 * np.sin(k / 5)])) for k in range(frames)]
    map_from_body = np.array([se3(turn, np.array([0.5 * k, 0, 0])) for k, turn in enumerate(turns)])
    ids = []
    for placed in map_from_body:
        in_cam = transform_points(se3_inverse(placed @ BODY_FROM_CAM), points)
        pixels = CAMERA.pixel_from_point(np.maximum(in_cam, [-1e9, -1e9, 0.1]))
        inside = (in_cam[:, 2] > 1) & (in_cam[:, 2] < 12) & (abs(pixels[:, :2] - (320, 240)) < (315, 235)).all(axis=1)
        ids.append(np.flatnonzero(inside)[:matches].astype(np.uint64))
    return Drive(map_from_body, ids, [points[i] for i in ids], [np.zeros(len(i)) for i in ids], CAMERA, BODY_FROM_CAM)


def residuals(map_from_body: Array, points: Array, pixels: Array) -> Array:
    """(K, 3) of u, v and the disparity, zero where that is unknown."""
    off = CAMERA.pixel_from_point(transform_points(se3_inverse(map_from_body @ BODY_FROM_CAM), points)) - pixels
    return np.nan_to_num(np.column_stack([off[:, :2], off[:, 0] - off[:, 2]]))


def test_the_level_after_a_fix_is_that_of_its_definition() -> None:
    rng, drive = np.random.default_rng(2), aisle(1, 30)
    fix, points = boxplus(drive.map_from_body[0], rng.normal(0.0, 0.004, 6)), drive.points_map[0]
    in_cam = transform_points(se3_inverse(drive.map_from_body[0] @ BODY_FROM_CAM), points)
    pixels = CAMERA.pixel_from_point(in_cam) + rng.normal(0.0, 1.0, points.shape)
    pixels[::4, 2] = np.nan
    middle = middle_of(aisle(1, 80).points_map[0], fix @ BODY_FROM_CAM)
    bank, still = core.ProtectionBank(), (np.eye(4), np.zeros((6, 6)))
    placed = middle, fix, BODY_FROM_CAM, (640, 480), 0.0, True, 0.0, *still
    assert bank.level(fix, *still, np.eye(6), np.zeros(3), RISK) == (np.inf, np.inf)
    bank.update(points, pixels, np.ones((len(points), 2)), CAMERA.lens, REFINEMENT, *placed)
    assert bank.level(fix, *still, np.eye(6), np.zeros(3), RISK)[0] > 100.0  # that fix may be wrong
    bank.repeat()

    off, step = residuals(fix, points, pixels), 1e-6 * np.eye(6)
    sides = [[residuals(boxplus(fix, sign * row), points, pixels) for sign in (1, -1)] for row in step]
    jacobian = np.moveaxis(np.array([(up - down) / 2e-6 for up, down in sides]), 0, 2)  # (K, 3, 6)
    by_fix = transform_points(se3_inverse(fix @ BODY_FROM_CAM), points)
    views = (by_fix / np.column_stack([by_fix[:, 2], by_fix[:, 2], np.ones(len(points))])).T
    halves = [view < value for view, value in zip(views, middle, strict=True)]
    halves.append(points[:, 2] < 1.0)
    out: list[tuple[float, Array]] = [(1e-3, side) for half in halves[:3] for side in (half, ~half)]
    parts = [(5e-2, np.floor(points[:, :2] / 2)), (1e-2, np.floor(pixels[:, :2] / 160))]
    out += [(prior, (cells == cell).all(axis=1)) for prior, cells in parts for cell in np.unique(cells, axis=0)]
    corner = np.floor(points[:, :2] / 2)
    zones = np.unique([row - shift for row in corner for shift in product(range(3), repeat=2)], axis=0)
    bends = [halves[3], ~halves[3], *(np.isin(corner - zone, range(3)).all(axis=1) for zone in zones)]
    bends = [mask for mask in bends if mask.any()]
    kept: list[tuple[float | None, Array]] = [(None, np.ones((len(points), 3), bool))]
    kept += [(prior, ~mask[:, None] & np.ones(3, bool)) for prior, mask in out if mask.any()]
    kept += [(1e-3, np.tile([True, True, False], (len(points), 1))), *2 * [(1e-3, np.ones((len(points), 3), bool))]]
    kept += [(1e-3, ~mask[:, None] & np.ones(3, bool)) for mask in bends]

    way, at = Place(se3(so3_exp(np.array([0, 0, 0.1])), np.array([0.5, 0, 0])), 1e-6 * np.eye(6)), np.array([0, 0.2, 1])
    levels = []
    for prior, mask in kept:
        moved = np.zeros(6)
        for _ in range(2):  # each filter weighs its matches at its own pose
            squared = ((off + jacobian @ moved) ** 2).sum(axis=1)
            weight = (squared < REFINEMENT[1]) * (16 / (16 + squared)) ** 2 / 1.6
            weights, flat = (weight[:, None] * mask).ravel(), jacobian.reshape(-1, 6)
            information = np.diag([1.0] * 3 + [1 / 900] * 3) + flat.T * weights @ flat
            moved = -np.linalg.solve(information, flat.T @ (weights * off.ravel()))
        here = Place(boxplus(fix, moved), np.linalg.inv(information)).at_end_of(way)
        there = Place(here[0], 1.56 * here.cov_rot_trans + np.diag(MAP_SIGMAS**2)).of_point(se3(np.eye(3), at))
        factor = chi(3).isf(RISK / 2 / (1 if prior is None else (len(kept) - 1) * prior))
        apart = boxminus(there.map_from_body, fix @ way.map_from_body @ se3(np.eye(3), at))
        sigmas = [np.sqrt(np.linalg.eigvalsh(there.cov_rot_trans[k : k + 3, k : k + 3])[-1]) for k in (3, 0)]
        level = [np.linalg.norm(apart[3:]) + factor * sigmas[0], np.linalg.norm(apart[:3]) + factor * sigmas[1]]
        bent = levels[0] + factor * np.array([0.04, 0.005]) if len(levels) >= len(kept) - len(bends) else np.inf
        levels.append(np.minimum(level, bent))
    found = bank.level(fix @ way.map_from_body, *way[:2], np.diag(MAP_SIGMAS**2), at.astype(float), RISK)
    assert found == pytest.approx(np.max(levels, axis=0), rel=1e-6)


@pytest.mark.parametrize("fault", [fault for fault, (prior, *_) in FAULTS.items() if prior])
def test_no_error_is_beyond_its_level(fault: str) -> None:
    drive = aisle()
    for number, size in enumerate(FAULTS[fault][1]):
        error_m, level_m, error_rad, level_rad = judged(drive, np.random.default_rng(number), fault, size).T
        assert (error_m < level_m).all() and (error_rad < level_rad).all()
        if fault == "none":
            assert len(error_m) > 80 and np.median(level_m) < 0.15 and np.median(error_m / level_m) > 0.05


def test_all_that_hangs_high_may_move_farther_than_a_map_bends() -> None:
    error_m, level_m, *_ = np.concatenate(
        [judged(aisle(), np.random.default_rng([913, n]), "all above a metre", 0.25) for n in range(12)]
    ).T
    assert error_m.max() > 0.25
    assert (error_m < level_m).all()


def test_matches_that_agree_with_neither_pose_draw_no_filter_along() -> None:
    drive = drive_of("identical-aisles", 1701)  # with gaps of ten seconds, in which few fixes pass
    error_m, level_m, *_ = judged(drive, np.random.default_rng([1701, 156]), "far half", 0.1).T
    assert error_m.max() > 0.11
    assert (error_m < level_m).all()


def test_a_level_without_one_of_its_parts_does_not_hold() -> None:
    sigmas = np.repeat([0.006, 0.02], 3)

    def beyond(risk: float, map_sigmas: Array) -> float:
        """Share of errors beyond the level where the map's error is five of its sigmas: as rare as the risk."""
        shift = "the whole map (excluded)"
        rows = judged(aisle(40), np.random.default_rng(1), shift, 0.1, risk, map_sigmas, bend_m=0.0)
        return float(np.mean(rows[:, 0] > rows[:, 1]))

    assert beyond(RISK, sigmas) == 0.0
    assert beyond(1e-2, sigmas) > 0.5  # the factor of another risk
    assert beyond(RISK, 1e-3 * sigmas) > 0.5  # without the map's own error
    level_m = judged(aisle(), np.random.default_rng(0), "none", 0.0)[:, 1]
    error_m = judged(aisle(), np.random.default_rng(1), "near half", 0.1)[:, 0]
    assert error_m.max() > 1.2 * np.median(level_m)  # K sigma alone, without the separation of the modes


class Seeing(Robot):
    """A scripted robot whose fixes have matches."""

    def _fix(self, offset: Array) -> Fix:
        fix, rng = super()._fix(offset), np.random.default_rng(self.frames)
        points = CAMERA.point_from_pixel(rng.uniform(20.0, 460.0, (80, 2)), rng.uniform(3.0, 24.0, 80))
        in_map, pixels = transform_points(fix.map_from_cam, points), CAMERA.pixel_from_point(points)
        return replace(fix, matched=Correspondences(CAMERA, in_map, pixels, np.ones((80, 2))))


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Seeing:
    monkeypatch.setattr(CalibrationWatch, "handle", lambda *_: None)
    return Seeing(strong_inliers=100).load(alias_step_m=2.0)


def levels_m(robot: Seeing, steps: int, offset_m: float = 0.0) -> Array:
    return np.array([estimate.protection_m for estimate in robot.ride(steps, 0.3, [off(offset_m)])])


def test_a_dock_is_the_evidence_of_a_few_looks(robot: Seeing) -> None:
    robot.told(0.1)
    assert levels_m(robot, 3)[-1] < 0.5
    robot.localizer.forget_pose()
    assert levels_m(robot, 3)[-1] == np.inf and levels_m(robot, 8)[-1] < 0.3


def test_a_robot_that_stands_has_a_level_once_it_was_told_its_place(robot: Seeing) -> None:
    assert all(estimate.protection_m == np.inf for estimate in robot.ride(8, 0.0, [off(0.0)]))
    robot.localizer.forget_pose()
    robot.told(0.1)
    assert [estimate.protection_m < 0.5 for estimate in robot.ride(8, 0.0, [off(0.0)])][-1]


def test_failed_looks_end_a_level_however_long_the_robot_was_right(robot: Seeing) -> None:
    levels_m(robot, 100)
    failed = [robot.go(0.6, NO_FIX) for _ in range(4)]  # the first one is of the look before
    assert all(estimate.status is Status.TRACKING for estimate in failed)
    assert [estimate.protection_m < 0.5 for estimate in failed] == [True, True, True, False]


def test_what_the_map_says_of_a_place_holds_until_fixes_of_the_next_one(robot: Seeing) -> None:
    robot.told(0.1)
    maps, wide = robot.localizer.maps, {(x, y): ErrorSigmas(0.002, 0.1, 0.1) for x in (2, 3) for y in (-2, -1)}
    own = {(x, y): ErrorSigmas(0.002, 0.002, 0.002) for x in range(9) for y in range(-9, 9)}
    maps.by_floor[""] = maps.by_floor[""]._replace(errors=MapErrors(4.0, own | wide))
    for step in range(70):
        is_wide = tuple(np.floor((robot.map_from_body @ [0.15 * (step > 0), 0, 0, 1])[:2] / 4.0)) in wide
        told = robot.go(0.15, [off(0.1 * is_wide)], turn_rad=0.0)
        if told.protection_m < np.inf:
            assert robot.error_m(told) < min(told.protection_m, 4.0 * np.sqrt(told.cov_rot_trans[3, 3]))
        assert step < 12 or told.status is Status.TRACKING


def test_odometry_that_went_astray_within_its_covariance_ends_no_level(robot: Seeing) -> None:
    robot.load(LookAlikes(0.0, 0.05, 0.0), alias_step_m=2.0)  # of a build that found nothing like its map
    levels_m(robot, 12)
    robot.odometry.drift_share = 0.1
    robot.ride(8, 0.4, NO_FIX)
    robot.odometry.drift_share = 0.0
    assert levels_m(robot, 8, 0.2)[-1] < 0.3


def test_no_level_holds_after_broken_tracks_nor_for_a_doubted_pose(robot: Seeing) -> None:
    assert levels_m(robot, 20)[-1] < 0.3
    robot.odometry.breaks = True
    assert robot.go(0.3, NO_FIX).protection_m == np.inf
    assert levels_m(robot, 8)[-1] < 0.3
    robot.odometry.drift_share, robot.inliers = 0.2, 100
    while robot.go(0.4, NO_FIX).cov_rot_trans[3, 3] < 0.31**2:
        pass
    robot.odometry.drift_share = 0.0
    known = levels_m(robot, 6)  # a strong fix confirms the pose again, and is one look
    assert (known[:3] == np.inf).all() and known[-1] < 1.0
