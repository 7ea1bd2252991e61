"""The error of a map by its own evidence: of two laps of a room, whose places are known exactly."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fleetmap.geometry import se3, skew, so3_exp
from fleetmap.sensors.rectification import StereoCamera
from mapserver.quality.map_error import _linearised, _marginals, _scales, error_words, map_errors
from mapserver.survey.survey_map import SurveyMap
from support.storage.map_samples import observed, plain_survey

CAMERA, LAP, TILES = StereoCamera(400.0, 320.0, 240.0, 0.1, 640, 480), 20, [(0, 0), (-1, 0)]


def two_laps(seed: int) -> SurveyMap:
    rng = np.random.default_rng(seed)
    looks_out = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    turns = [so3_exp(np.array([0, 0, a])) @ looks_out for a in np.linspace(0.0, 4 * np.pi, 2 * LAP, endpoint=False)]
    at = np.array([se3(turn, 3.0 * turn[:, 2] + [0, 0, 0.1 * turn[0, 0]]) for turn in turns])
    way, far_m = rng.uniform(0, 2 * np.pi, 300), rng.uniform(5.0, 8.0, 300)
    points = np.column_stack([far_m * np.cos(way), far_m * np.sin(way), rng.uniform(-1.5, 1.5, 300)])
    landmark, keyframe = (each.ravel() for each in np.mgrid[:300, : len(at)])
    in_cam = np.einsum("mji,mj->mi", at[keyframe, :3, :3], points[landmark] - at[keyframe, :3, 3])
    pixels = CAMERA.pixel_from_point(np.maximum(in_cam, [-99, -99, 0.1]))
    seen = (in_cam[:, 2] > 0.5) & (np.abs(pixels[:, :2] - [320, 240]) < [320, 240]).all(axis=1)
    noise = rng.normal(size=(seen.sum(), 3)) * [0.8, 0.8, 0.3] @ np.array([[1, 0, 1], [0, 1, 0], [0, 0, -1.0]])
    made = SimpleNamespace(points_map=points, obs_keyframe=keyframe[seen], obs_landmark=landmark[seen])
    made.obs_pixels, made.obs_sigma_px = pixels[seen] + noise, np.tile([0.8, 0.3], (seen.sum(), 1))
    return plain_survey(CAMERA, np.eye(4), at, made)


def test_marginals_are_those_of_the_whole_adjustment_after_the_best_alignment() -> None:
    survey = two_laps(0)
    at, size = survey.map_from_body, 6 * len(survey.map_from_body)
    by_camera, by_point, residuals = _linearised(survey, at)
    rows = np.arange(residuals.size).reshape(-1, 3, 1)
    jacobian = np.zeros((rows.size, size + survey.points_map.size))
    jacobian[rows, 6 * survey.obs_keyframe[:, None, None] + np.arange(6)] = by_camera
    jacobian[rows, size + 3 * survey.obs_landmark[:, None, None] + np.arange(3)] = by_point
    covariance = np.linalg.inv(jacobian.T @ jacobian + 1e-3 * np.eye(jacobian.shape[1]))[:size, :size]
    whole = np.vstack([np.block([[np.eye(3), np.zeros((3, 3))], [-skew(p), np.eye(3)]]) for p in at[:, :3, 3]])
    rest = np.eye(size) - whole @ np.linalg.pinv(whole)
    found = _marginals(survey, at, (by_camera, by_point, residuals), np.arange(len(at)))
    np.testing.assert_allclose(found.ravel(), np.diag(rest @ covariance @ rest.T), rtol=0.02)


def test_what_passes_disagree_beyond_their_noise_is_an_error_and_without_passes_it_is_unknown() -> None:
    survey = two_laps(2)
    own, apart = map_errors(survey, TILES, 16.0), survey.map_from_body.copy()
    apart[LAP:, 0, 3] += 0.04
    moved = map_errors(replace(survey, map_from_body=apart), TILES, 16.0)
    assert 0.001 < own["0,0"].horizontal_m < 0.012
    assert 0.021 < moved["0,0"].horizontal_m < 0.06, "wider than where it is unknown"
    for less in (observed(survey, survey.obs_keyframe < LAP // 2), replace(survey, scale_known=False)):
        assert map_errors(less, TILES, 16.0) == {}
    assert error_words({}).startswith("own error unknown")


def test_looks_that_hardly_tell_do_not_widen_the_map_by_some_bad_ones_and_a_bent_stretch_does() -> None:
    of_looks = np.repeat([0.0004, 0.02], 40)[:, None] ** 2
    squared = 0.6 * of_looks
    squared[-3:] = 0.1**2
    assert np.mean(squared / of_looks) > 1.2 and _scales(squared, of_looks) == (1.0, 0.0)
    squared[:8] = 0.01**2
    assert _scales(squared, of_looks)[1] > 0.003**2
    squared[:40], squared[40:] = 0.6 * of_looks[:40], 0.1**2  # all vague looks are far off
    assert _scales(squared, of_looks)[1] > 0.04**2


def test_tiles_without_marginals_of_their_own_have_those_of_the_nearest_place(monkeypatch: pytest.MonkeyPatch) -> None:
    survey, tiles = two_laps(0), [(0, 0), (-1, 0), (-1, -1), (0, -1)]
    every = map_errors(survey, tiles, 16.0)
    monkeypatch.setattr("mapserver.quality.map_error._MOST_PLACES", 1)
    assert len(set(every.values())) > 1 == len(set(map_errors(survey, tiles, 16.0).values()))
    assert map_errors(survey, [(9, 9)], 16.0) == {}


def test_drives_that_see_no_landmark_in_common_widen_no_error() -> None:
    survey = two_laps(0)
    first = (survey.obs_keyframe < 32) & (survey.obs_landmark % 3 > 0)
    later = (survey.obs_keyframe >= 32) & (survey.obs_landmark % 3 == 0)
    found = map_errors(observed(survey, first | later), TILES, 16.0)
    assert found == map_errors(observed(survey, first), TILES, 16.0) != {}
    assert found["0,0"].horizontal_m < 0.019
