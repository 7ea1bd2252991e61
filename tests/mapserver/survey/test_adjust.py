"""Adjustment of a made-up survey: errors shrink to the noise, outliers go, windows leave all else alone."""

from dataclasses import dataclass

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp, transform_points
from fleetmap.rectification import StereoCamera
from fleetmap.samples import ImuSamples
from mapserver.survey.adjust import Motion, SurveyState, adjust, adjust_windows
from mapserver.survey.settings import NoiseSettings, SurveySettings
from mapserver.survey.tracks import Landmarks

CAMERA = StereoCamera(300.0, 320.0, 240.0, 0.12, 640, 480)
BODY_FROM_CAM = se3(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.array([0.1, 0.05, 0.2]))
SIGMA_PX, SIGMA_DISPARITY_PX = 0.3, 0.15


@dataclass
class Scene:
    """A survey as it comes from odometry, and what is true."""

    state: SurveyState
    map_from_body: Array
    points_map: Array
    is_outlier: Array


def scene(keyframes: int, seed: int, *, drift: float, outliers: float = 0.0) -> Scene:
    """A drive along a corridor of points; odometry is off by `drift` (m; a tenth of it in rad) each step."""
    rng = np.random.default_rng(seed)
    step = se3(so3_exp(np.array([0, 0, 0.01])), np.array([0.3, 0, 0]))
    true, guess = [np.eye(4)], [np.eye(4)]
    for _ in range(keyframes - 1):
        error = se3_exp(rng.normal(0, drift, 6) * [0.1, 0.1, 0.1, 1, 1, 1])
        true.append(true[-1] @ step)
        guess.append(guess[-1] @ step @ error)
    map_from_body, guessed = np.array(true), np.array(guess)
    along = map_from_body[rng.integers(0, keyframes, 25 * keyframes), :3, 3]
    ahead = rng.uniform(2, 8, len(along))
    aside = rng.choice([-2.0, 2.0], len(along)) * rng.uniform(0.5, 1, len(along))
    points = along + np.column_stack([ahead, aside, rng.uniform(-1, 1.5, len(along))])
    rows = []
    for k in range(keyframes):
        seen = transform_points(se3_inverse(map_from_body[k] @ BODY_FROM_CAM), points)
        pixels = CAMERA.pixel_from_point(seen)
        visible = (seen[:, 2] > 1) & (seen[:, 2] < 10) & (pixels > 0).all(axis=1)
        visible &= (pixels[:, 0] < CAMERA.width_px) & (pixels[:, 1] < CAMERA.height_px)
        rows += [(n, k, *pixels[n]) for n in np.flatnonzero(visible)]
    table = np.array(sorted(rows))
    counts = np.bincount(table[:, 0].astype(int), minlength=len(points))
    lasting = counts >= 3
    number = np.cumsum(lasting) - 1
    table = table[lasting[table[:, 0].astype(int)]]
    points = points[lasting]
    landmark, keyframe = number[table[:, 0].astype(int)].astype(np.int32), table[:, 1].astype(np.int32)
    noise = rng.normal(0, SIGMA_PX, (len(table), 3))
    noise[:, 2] = noise[:, 0] - rng.normal(0, SIGMA_DISPARITY_PX, len(table))
    is_outlier = rng.random(len(table)) < outliers
    noise[is_outlier, :2] += rng.choice([-1, 1], (is_outlier.sum(), 2)) * rng.uniform(8, 40, (is_outlier.sum(), 2))
    noise[is_outlier, 2] = noise[is_outlier, 0]
    first = np.r_[True, np.diff(landmark) > 0]
    reference = keyframe[first]
    moved = guessed[reference] @ se3_inverse(map_from_body[reference])
    started = np.einsum("nij,nj->ni", moved[:, :3, :3], points) + moved[:, :3, 3]
    marks = Landmarks(
        started, keyframe, landmark, np.arange(len(table)), table[:, 2:] + noise,
        np.tile([SIGMA_PX, SIGMA_DISPARITY_PX], (len(table), 1)),
    )  # fmt: skip
    nothing = np.zeros((keyframes, 3))
    motion = Motion(False, ImuSamples.empty(), None, 0.0, nothing, nothing.copy(), nothing.copy(), [])
    stamps = np.arange(keyframes, dtype=np.int64) * 100_000_000
    return Scene(
        SurveyState(stamps, guessed.copy(), BODY_FROM_CAM, CAMERA, motion, marks), map_from_body, points, is_outlier
    )


def neighbour_errors_m(given: Scene) -> Array:
    """(K - 1,) how far the motion between neighbours is from the true one."""
    found, true = given.state.map_from_body, given.map_from_body
    steps = [se3_inverse(m[:-1]) @ m[1:] for m in (found, true)]
    return np.linalg.norm(steps[0][:, :3, 3] - steps[1][:, :3, 3], axis=1)


def test_adjustment_brings_the_survey_to_its_noise() -> None:
    given = scene(12, 1, drift=0.03)
    before = np.linalg.norm(given.state.map_from_body[:, :3, 3] - given.map_from_body[:, :3, 3], axis=1).max()
    result = adjust(given.state, SurveySettings())
    after = np.linalg.norm(given.state.map_from_body[:, :3, 3] - given.map_from_body[:, :3, 3], axis=1).max()
    assert before > 0.05
    assert after < 0.01
    np.testing.assert_array_equal(given.state.map_from_body[0], given.map_from_body[0])  # the gauge
    near = np.linalg.norm(given.points_map - given.map_from_body[0, :3, 3], axis=1) < 6
    off = np.linalg.norm(given.state.landmarks.points_map - given.points_map, axis=1)[near]
    assert np.median(off) < 0.03
    assert len(result.squared_sigmas) == len(given.state.landmarks.obs_landmark)


def test_outliers_are_dropped_and_hardly_anything_else() -> None:
    given = scene(12, 2, drift=0.02, outliers=0.06)
    total = len(given.is_outlier)
    adjust(given.state, SurveySettings())
    kept = np.zeros(total, bool)
    kept[given.state.landmarks.obs_feature] = True  # features are numbered by row
    assert given.is_outlier.sum() > 50
    assert kept[given.is_outlier].mean() < 0.02
    assert kept[~given.is_outlier].mean() > 0.97
    assert neighbour_errors_m(given).max() < 0.01
    counts = np.bincount(given.state.landmarks.obs_landmark, minlength=len(given.state.landmarks.points_map))
    assert counts.min() >= SurveySettings().min_observations


def test_one_round_drops_nothing() -> None:
    given = scene(6, 3, drift=0.01, outliers=0.05)
    adjust(given.state, SurveySettings(), rounds=1)
    assert len(given.state.landmarks.obs_landmark) == len(given.is_outlier)


def test_a_lax_cut_keeps_what_a_strict_one_drops() -> None:
    lax, strict = scene(6, 4, drift=0.01), scene(6, 4, drift=0.01)
    adjust(lax.state, SurveySettings(noise=NoiseSettings(cut_sigmas=50.0)))
    adjust(strict.state, SurveySettings(noise=NoiseSettings(cut_sigmas=2.0)))
    assert len(lax.state.landmarks.obs_landmark) == len(lax.is_outlier) > len(strict.state.landmarks.obs_landmark)


def test_a_window_moves_nothing_outside() -> None:
    given = scene(14, 5, drift=0.02, outliers=0.03)
    free = np.zeros(14, bool)
    free[5:9] = True
    start = given.state.map_from_body.copy()
    outside = ~free[given.state.landmarks.obs_keyframe]
    adjust(given.state, SurveySettings(), free)
    np.testing.assert_array_equal(given.state.map_from_body[~free], start[~free])
    assert (np.linalg.norm((given.state.map_from_body - start)[free, :3, 3], axis=1) > 1e-4).all()
    left = np.isin(np.flatnonzero(outside), given.state.landmarks.obs_feature)
    assert left.mean() > 0.97  # observations from outside go only with their landmark


@pytest.mark.parametrize("seed", [6, 7])
def test_windows_take_the_error_out_of_a_chain(seed: int) -> None:
    """What is left is drift of the whole, which only loops can show; between neighbours the error is the noise."""
    given = scene(45, seed, drift=0.03)
    before = neighbour_errors_m(given)
    adjust_windows(given.state, SurveySettings(local_window=12))
    after = neighbour_errors_m(given)
    assert np.median(before) > 0.03
    assert np.median(after) < 0.05 * np.median(before)
    assert after.max() < 0.1 * before.max()
    np.testing.assert_array_equal(given.state.map_from_body[0], np.eye(4))
    end_m = np.linalg.norm(given.state.map_from_body[-1, :3, 3] - given.map_from_body[-1, :3, 3])
    assert end_m < 0.02  # of 13 m; later keyframes, which are still where odometry put them, must not hold a window


def test_a_survey_of_one_window_is_left_to_the_global_adjustment() -> None:
    given = scene(8, 8, drift=0.02)
    start = given.state.map_from_body.copy()
    adjust_windows(given.state, SurveySettings(local_window=8))
    np.testing.assert_array_equal(given.state.map_from_body, start)


def test_cameras_see_each_other_through_the_mounting() -> None:
    given = scene(3, 9, drift=0.02)
    expected = se3_inverse(given.state.map_from_body[2] @ BODY_FROM_CAM) @ given.state.map_from_body[0] @ BODY_FROM_CAM
    np.testing.assert_allclose(given.state.cam_from_cam(2, 0), expected, atol=1e-12)
