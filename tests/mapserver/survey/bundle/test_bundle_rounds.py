"""Adjustment of a made-up survey: errors shrink to the noise, outliers go, windows leave all else alone."""

import numpy as np
import pytest

from mapserver.survey.bundle.bundle_rounds import bundle_rounds, local_windows
from mapserver.survey.settings import SurveySettings
from support.worlds.corridor_scene import neighbour_errors_m, scene


def test_adjustment_brings_the_survey_to_its_noise() -> None:
    given = scene(12, 1, drift=0.03)
    before = np.linalg.norm(given.state.map_from_body[:, :3, 3] - given.map_from_body[:, :3, 3], axis=1).max()
    given.state = bundle_rounds(given.state, SurveySettings())
    after = np.linalg.norm(given.state.map_from_body[:, :3, 3] - given.map_from_body[:, :3, 3], axis=1).max()
    assert before > 0.05
    assert after < 0.01
    np.testing.assert_array_equal(given.state.map_from_body[0], given.map_from_body[0])  # the gauge
    near = np.linalg.norm(given.points_map - given.map_from_body[0, :3, 3], axis=1) < 6
    off = np.linalg.norm(given.state.landmarks.points_map - given.points_map, axis=1)[near]
    assert np.median(off) < 0.03
    assert len(given.state.landmarks.obs_pixels) == len(given.state.landmarks.obs_landmark)


def test_outliers_are_dropped_and_hardly_anything_else() -> None:
    given = scene(12, 2, drift=0.02, outliers=0.06)
    total = len(given.is_outlier)
    given.state = bundle_rounds(given.state, SurveySettings())
    kept = np.zeros(total, bool)
    kept[given.state.landmarks.obs_feature] = True  # features are numbered by row
    assert given.is_outlier.sum() > 50
    assert kept[given.is_outlier].mean() < 0.02
    assert kept[~given.is_outlier].mean() > 0.97
    assert neighbour_errors_m(given).max() < 0.01
    counts = np.bincount(given.state.landmarks.obs_landmark, minlength=len(given.state.landmarks.points_map))
    assert counts.min() >= SurveySettings().min_observations


@pytest.mark.parametrize("seed", [6, 7])
def test_windows_take_the_error_out_of_a_chain(seed: int) -> None:
    """What is left is drift of the whole, which only loops can show; between neighbours the error is the noise."""
    given = scene(45, seed, drift=0.03)
    before = neighbour_errors_m(given)
    given.state = local_windows(given.state, SurveySettings(local_window=12))
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
    given.state = local_windows(given.state, SurveySettings(local_window=8))
    np.testing.assert_array_equal(given.state.map_from_body, start)
