"""The covariances that bundle adjustment claims against the scatter of its errors."""

from dataclasses import replace

import numpy as np

from fleetmap.geometry import so3_log
from mapserver.survey.bundle.bundle_adjustment import keyframe_covariances, optimize
from mapserver.survey.bundle.settings import BundleSettings
from support.worlds.bundle_scene import make_scene


def test_errors_are_as_large_as_claimed() -> None:
    """Normalised squared errors of 5 poses in 60 noisy runs: their mean stays in the 99.9 % band around 6."""
    truth = make_scene(keyframes=6, landmarks=200, step_s=0.3, seed=41).problem
    rng = np.random.default_rng(42)
    settings = BundleSettings(max_iterations=20, huber_sigmas=1e6, relative_cost_tolerance=1e-9)
    squared = np.zeros((60, 5))
    for run in range(60):
        u, v, d = rng.normal(size=(3, len(truth.obs_pixels)))
        sigma, pixels = truth.obs_sigma_px, truth.obs_pixels.copy()
        pixels[:, 0] += u * sigma[:, 0]
        pixels[:, 1] += v * sigma[:, 0]
        pixels[:, 2] += u * sigma[:, 0] - d * sigma[:, 1]
        noisy = replace(truth, obs_pixels=pixels)
        result = optimize(noisy, settings)
        covariances = keyframe_covariances(
            replace(noisy, map_from_body=result.map_from_body, points_map=result.points_map)
        )
        for k in range(1, 6):
            ours, known = result.map_from_body[k], truth.map_from_body[k]
            error = np.concatenate([so3_log(ours[:3, :3] @ known[:3, :3].T), ours[:3, 3] - known[:3, 3]])
            squared[run, k - 1] = error @ np.linalg.solve(covariances[k], error)
    # poses of one run share the held keyframe, so the band is that of 60 independent runs, not 300
    assert abs(squared.mean() - 6.0) < 3.3 * np.sqrt(12.0 / 60)
