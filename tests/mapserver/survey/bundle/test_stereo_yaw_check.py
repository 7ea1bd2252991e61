"""A right camera that is turned is found out by the survey; a well calibrated one is left alone, depth cameras always."""

from dataclasses import replace

import numpy as np
import pytest

from mapserver.survey.bundle.bundle_rounds import bundle_rounds
from mapserver.survey.bundle.stereo_yaw_check import NO_YAW, disparity_shift, estimate_stereo_yaw, without_stereo_yaw
from mapserver.survey.rig import CameraKind
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import SurveyState
from support.worlds.corridor_scene import CAMERA, scene

SETTINGS = SurveySettings()


def adjusted(seed: int, turn_px: float) -> SurveyState:
    """A made-up survey with disparities that are too large by turn_px, adjusted as they are."""
    state = scene(24, seed, drift=0.01).state
    state = replace(state, landmarks=without_stereo_yaw(state.landmarks, CAMERA, -turn_px))
    return bundle_rounds(state, SETTINGS, final=True)


@pytest.mark.parametrize("turn_px", [-0.3, 0.2])
def test_the_shift_is_found_with_its_sign(turn_px: float) -> None:
    found = estimate_stereo_yaw(adjusted(1, turn_px), SETTINGS)
    assert found.corrected
    assert found.shift_px == pytest.approx(turn_px, abs=0.05)
    assert abs(found.shift_px - turn_px) < 3 * found.sigma_px


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_an_exact_calibration_is_believed(seed: int) -> None:
    found = estimate_stereo_yaw(adjusted(seed, 0.0), SETTINGS)
    assert abs(found.shift_px) < 3 * found.sigma_px
    assert not found.corrected
    assert found.correction_px == 0.0


def test_taking_the_shift_out_gives_the_survey_its_scale_back() -> None:
    """0.3 px of 12 px disparity bend the path by percents; corrected, it is as long as it was driven."""
    state, truth = adjusted(5, 0.3), scene(24, 5, drift=0.01).map_from_body
    length_m = float(np.linalg.norm(truth[-1, :3, 3] - truth[0, :3, 3]))
    before = float(np.linalg.norm(state.map_from_body[-1, :3, 3])) / length_m
    found = estimate_stereo_yaw(state, SETTINGS)
    state = replace(state, landmarks=without_stereo_yaw(state.landmarks, CAMERA, found.correction_px))
    state = bundle_rounds(state, SETTINGS, final=True)
    after = float(np.linalg.norm(state.map_from_body[-1, :3, 3])) / length_m
    assert abs(before - 1.0) > 0.01
    assert abs(after - 1.0) < 0.2 * abs(before - 1.0)


def test_the_shift_grows_towards_the_rim_as_a_turn_makes_it() -> None:
    """Against the exact picture of a camera turned by a small angle."""
    angle, f = 1e-4, CAMERA.focal_px
    x = np.linspace(10.0, 630.0, 7)
    turned = f * np.tan(np.arctan((x - CAMERA.cx_px) / f) + angle) + CAMERA.cx_px
    np.testing.assert_allclose(disparity_shift(CAMERA, x[:, None]), (turned - x) / (f * angle), rtol=1e-3)


def test_depth_cameras_and_single_cameras_have_no_pair() -> None:
    state = adjusted(6, 0.0)
    assert estimate_stereo_yaw(replace(state, rig=replace(state.rig, kinds=(CameraKind.DEPTH,))), SETTINGS) == NO_YAW
    blind = state.landmarks.obs_pixels.copy()
    blind[:, 2] = np.nan
    assert estimate_stereo_yaw(replace(state, landmarks=replace(state.landmarks, obs_pixels=blind)), SETTINGS) == NO_YAW
