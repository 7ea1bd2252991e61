"""Measurement of the observations' noise from the residuals of an adjustment.

Too large stated sigmas make robust costs ineffective: at depth edges disparities are too large, never too small (foreground
fattening), and errors within one stated sigma bias the scale. The noise differs between cameras,
so the survey measures it, for each class of the stated sigma.
"""

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from mapserver.survey.bundle.problem import BundleProblem

_CLASSES = 8
_CHUNK = 50_000  # observations; poses and points take 0.3 kB each
_LEAST_OBSERVATIONS = 100  # of a class: its median is then accurate to 15 %
# Medians of |x| and of the length of a pair for normal noise of sigma 1
_MEDIAN_OF_ONE, _MEDIAN_OF_TWO = 0.6745, 1.1774
_EFFICIENT_HUBER = 1.345  # noise sigmas from which the cost is linear: 95 % efficient on normal noise (Huber 1964)


def measured_sigmas(problem: BundleProblem, huber_sigmas: float) -> Array:
    """Return (M, 2) sigmas of pixels and disparities for a robust cost that is linear from huber_sigmas.

    Observations are grouped into classes by their stated sigma. Each class is scaled by one factor: the ratio of the median
    residual at the problem's values to the stated sigma. The factor also corrects for a cost that
    is linear from elsewhere than 1.345 noise sigmas. Classes of less than 100 observations are unchanged.
    """
    pixel, disparity = _residuals(problem)
    widened = _EFFICIENT_HUBER / huber_sigmas
    claimed = problem.obs_sigma_px
    columns = [_by_class(pixel / _MEDIAN_OF_TWO, claimed[:, 0]), _by_class(disparity / _MEDIAN_OF_ONE, claimed[:, 1])]
    return widened * np.stack(columns, axis=1)


def _residuals(problem: BundleProblem) -> tuple[Array, Array]:
    """Return lengths (M,) of the residuals of pixel and disparity, NaN if absent."""
    cam_from_map = se3_inverse(problem.map_from_cams)
    pixel, disparity = np.empty((2, len(problem.obs_keyframe)))
    for first in range(0, len(pixel), _CHUNK):
        rows = slice(first, first + _CHUNK)
        own = cam_from_map[problem.obs_keyframe[rows], problem.obs_camera[rows]]
        points = problem.points_map[problem.obs_landmark[rows]]
        seen = np.einsum("mij,mj->mi", own[:, :3, :3], points) + own[:, :3, 3]
        off = problem.rig.camera.pixel_from_point(seen) - problem.obs_pixels[rows]
        pixel[rows], disparity[rows] = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 0] - off[:, 2])
    return pixel, disparity


def _by_class(noise: Array, claimed: Array) -> Array:
    """Return (M,) the stated sigmas times the median ratio of noise to stated sigma in each class."""
    known = np.isfinite(noise)
    count = min(_CLASSES, int(known.sum()) // _LEAST_OBSERVATIONS)
    if count == 0:
        return claimed
    limits = np.unique(np.quantile(claimed[known], np.arange(1, count) / count))
    number, sigmas = np.searchsorted(limits, claimed), claimed.copy()
    for each in range(len(limits) + 1):
        own = number == each
        if (own & known).sum() >= _LEAST_OBSERVATIONS // 2:
            sigmas[own] *= np.median(noise[own & known] / claimed[own & known])
    return sigmas
