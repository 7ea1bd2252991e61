"""Parameters of the cameras from one frame: each is found where it is, with the sigma that its noise makes."""

import numpy as np
import pytest

from fleetmap.geometry import Array, se3_inverse
from fleetmap.pnp.pnp import Correspondences, refine_pnp
from locclient.localization.calibration.camera_view import CameraView, camera_view
from locclient.localization.calibration.parameters import FOCAL, IMAGE, PITCH, RIGHT_FOCAL, ROLL, YAW
from support.worlds.pinhole_pair import CAMERA, seen_with


def view_of(parameters: Array, seed: int) -> tuple[CameraView, Array]:
    """The view from where PnP places the camera, as a fix does, and that place's error in metres."""
    matched, map_from_cam, rows = seen_with(parameters, seed)
    found = refine_pnp(matched, se3_inverse(map_from_cam))
    assert found is not None
    placed = se3_inverse(found.cam_from_source)
    view = camera_view(matched, placed, rows)
    assert view is not None
    return view, placed[:3, 3] - map_from_cam[:3, 3]


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
    off = []
    for seed in range(60):
        view, _ = view_of(np.zeros(IMAGE), seed)
        error = np.linalg.solve(view.information, view.score)
        off.append(error @ view.information @ error / IMAGE)
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
