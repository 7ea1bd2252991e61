"""Sub-pixel disparities of features in a rectified pair."""

import numpy as np

from fleetmap import core
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera


def disparities(
    frame: RectifiedFrame, camera: StereoCamera, pixels: Array, settings: StereoSettings, prior_px: Array | None = None
) -> Array:
    """(N, 2) disparity and standard deviation in pixels for left pixels (N, 2); NaN where unknown.

    prior_px (N,), NaN for none, confines the search to a few pixels around. From the depth image where the frame has
    one, NaN throughout for a single camera.
    """
    count = len(pixels)
    if frame.disparity_px is not None:
        return core.match_depth(frame.disparity_px, np.ascontiguousarray(pixels, np.float64), settings.depth_sigma_px)
    if frame.right is None or count == 0:
        return np.full((count, 2), np.nan)
    max_disparity = max_disparity_px(camera, settings)
    prior = np.full(count, np.nan) if prior_px is None else np.asarray(prior_px, np.float64)
    # whole images are only searched at half size
    halves = (frame.left, frame.right) if np.isfinite(prior).all() else (frame.half_left, frame.half_right)
    sought = np.ascontiguousarray(pixels, np.float64), prior
    matched = core.match_rows(frame.left, frame.right, *halves, *sought, settings, max_disparity)
    matched[~(matched[:, 0] > settings.min_disparity_px)] = np.nan
    return matched


def max_disparity_px(camera: StereoCamera, settings: StereoSettings) -> float:
    """Largest disparity of the search."""
    return min(camera.focal_px * camera.baseline_m / settings.min_depth_m, 0.6 * camera.width_px)
