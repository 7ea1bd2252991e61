"""The map that a survey is joined to, ready to be looked at from anywhere."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.geometry import Array, se3_inverse, transform_points
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.finish.landmark_visibility import Views
from mapserver.survey.merge.initial_history import history_of
from mapserver.survey.survey_map import SurveyMap

Rows = NDArray[np.int64]
_NEAREST_M = 0.2
_REACH_SHARE = 1.3  # of the distance up to which a landmark was found: detection does not end sharply
_NEIGHBOURHOOD_M = 3.0


class BaseMap:
    """A SurveyMap read as if `camera` on a rig with `body_from_cam` had made it: the same pinhole, another baseline perhaps.

    map_from_cam, map_from_body (K, 4, 4); points_map (N, 3), descriptors (N, 32); obs_pixels (M, 3) and obs_sigma_px (M, 2) as
    `camera` would have them; references (N,): the first observation of each landmark, -1 without any.
    """

    def __init__(self, survey_map: SurveyMap, camera: StereoCamera, body_from_cam: Array) -> None:
        self.map = survey_map
        self.camera = camera
        self.history = history_of(survey_map)
        self.map_from_cam = survey_map.map_from_body @ survey_map.body_from_cam
        self.map_from_body = self.map_from_cam @ se3_inverse(body_from_cam)
        self.views = Views(survey_map, self.map_from_cam)
        self.points_map, self.descriptors = survey_map.points_map, survey_map.descriptors
        own = survey_map.camera
        self.baseline_ratio = camera.baseline_m / own.baseline_m if own.baseline_m and camera.baseline_m else 1.0
        self.obs_pixels, self.obs_sigma_px = _with_baseline(
            survey_map.obs_pixels, survey_map.obs_sigma_px, self.baseline_ratio
        )
        self.references = np.full(len(self.points_map), -1)
        seen, first = np.unique(survey_map.obs_landmark, return_index=True)
        self.references[seen] = first

    def visible(self, map_from_cam: Array, margin_px: float, max_view_angle_rad: float) -> tuple[Rows, Array, Array]:
        """Rows (V,) of landmarks that a camera there should see, their pixels (V, 3) and expected octaves (V,)."""
        seen = transform_points(se3_inverse(map_from_cam), self.points_map)
        pixels = self.camera.pixel_from_point(seen)
        distances_m = np.linalg.norm(seen, axis=1)
        reaches_m = self.views.max_distance_m
        towards = (map_from_cam[:3, 3] - self.points_map) / np.maximum(distances_m, 1e-9)[:, None]
        cosines = np.einsum("ij,ij->i", towards, self.views.directions_map)
        wide = np.minimum(self.views.half_angle_rad + max_view_angle_rad, np.pi)
        with np.errstate(invalid="ignore"):
            inside = (
                (self.views.counts > 0)
                & (distances_m > _NEAREST_M)
                & (distances_m < _REACH_SHARE * reaches_m)
                & (cosines > np.cos(wide))
                & (pixels[:, 0] > -margin_px)
                & (pixels[:, 0] < self.camera.width_px + margin_px)
                & (pixels[:, 1] > -margin_px)
                & (pixels[:, 1] < self.camera.height_px + margin_px)
            )
        rows = np.flatnonzero(inside)
        octaves = np.log(np.maximum(reaches_m[rows] / distances_m[rows], 0.5)) / np.log(SCALE_FACTOR)
        return rows, pixels[rows], octaves

    def neighbourhood(self, keyframe: int) -> Rows:
        """Rows of all landmarks of keyframes near one keyframe that look a similar way."""
        positions, axes = self.map_from_cam[:, :3, 3], self.map_from_cam[:, :3, 2]
        near = np.linalg.norm(positions - positions[keyframe], axis=1) < _NEIGHBOURHOOD_M
        near &= axes @ axes[keyframe] > 0.5
        return np.unique(self.map.obs_landmark[near[self.map.obs_keyframe]]).astype(np.int64)

    def reference_cameras(self, rows: Rows) -> Array:
        """(V, 4, 4) map_from_cam of the keyframes that the patches of `rows` were cut from."""
        return np.asarray(self.map_from_cam[self.map.obs_keyframe[self.references[rows]]])


def _with_baseline(pixels: Array, sigmas_px: Array, ratio: float) -> tuple[Array, Array]:
    """Observations as a pair with another baseline would have made them, farther apart by `ratio`: disparities grow with it."""
    disparity = (pixels[:, 0] - pixels[:, 2]) * ratio
    return np.column_stack([pixels[:, :2], pixels[:, 0] - disparity]), np.asarray(sigmas_px * [1.0, abs(ratio)])


def as_recorded(base: BaseMap, pixels: Array, sigmas_px: Array) -> tuple[Array, Array]:
    """Observations (M, 3), (M, 2) of BaseMap's camera as the camera that made the map would have them."""
    return _with_baseline(pixels, sigmas_px, 1.0 / base.baseline_ratio)
