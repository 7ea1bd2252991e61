"""The map to which a survey is joined, prepared for queries from any pose."""

import numpy as np

from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.geometry import Array, se3_inverse
from fleetmap.mapformat.tile import Tile
from fleetmap.relocalization.map_view import MapView
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.survey_map import SurveyMap, history_of, viewing_cones


class BaseMap:
    """A SurveyMap converted to `camera` on a rig with `body_from_cam`: the same pinhole, perhaps another baseline.

    map_from_cam, map_from_body (K, 4, 4); points_map (N, 3), descriptors (N, 32); obs_pixels (M, 3) and obs_sigma_px (M, 2) as
    in `camera`; references (N,): the first observation of each landmark, -1 without any.
    """

    def __init__(self, survey_map: SurveyMap, camera: StereoCamera, body_from_cam: Array) -> None:
        self.map = survey_map
        self.camera = camera
        self.history = history_of(survey_map)
        self.map_from_cam = survey_map.map_from_body @ survey_map.body_from_cam
        self.map_from_body = self.map_from_cam @ se3_inverse(body_from_cam)
        self.cones = viewing_cones(survey_map, self.map_from_cam)
        self.points_map, self.descriptors = survey_map.points_map, survey_map.descriptors
        self.baseline_ratio = baseline_ratio(camera, survey_map.camera)
        self.obs_pixels, self.obs_sigma_px = with_baseline(
            survey_map.obs_pixels, survey_map.obs_sigma_px, self.baseline_ratio
        )
        self.references = np.full(len(self.points_map), -1)
        seen, first = np.unique(survey_map.obs_landmark, return_index=True)
        self.references[seen] = first

    def view(self, vocabulary: Vocabulary) -> MapView:
        """Return the whole map in the robots' form, but with all landmarks and keyframes at the archive's precision, not in tiles."""
        cones, old = self.cones, self.map
        order = np.argsort(old.obs_keyframe, kind="stable")
        ends = np.cumsum(np.bincount(old.obs_keyframe, minlength=len(self.map_from_cam)))
        seen = np.split(old.landmark_ids[old.obs_landmark[order]], ends[:-1])
        whole = Tile(
            tile_x=0,
            tile_y=0,
            size_m=np.inf,
            landmark_ids=old.landmark_ids,
            points_map=cones.points_map,
            descriptors=old.descriptors,
            view_directions_map=cones.directions_map,
            view_half_angle_rad=cones.half_angles_rad,
            max_distance_m=cones.max_distances_m,
            sigma_m=old.point_sigma_m.astype(np.float32),
            place_ids=self.history.keyframe_ids,
            map_from_cam=self.map_from_cam,
            place_landmark_ids=tuple(seen),
        )
        return MapView([whole], vocabulary, self.camera.focal_px)


def baseline_ratio(camera: StereoCamera, other: StereoCamera) -> float:
    """Return the ratio of disparities of `camera` to the other's; 1 if one of them is a single camera without any."""
    return camera.baseline_m / other.baseline_m if camera.baseline_m and other.baseline_m else 1.0


def with_baseline(pixels: Array, sigmas_px: Array, ratio: float) -> tuple[Array, Array]:
    """Return the observations of a pair with a baseline larger by `ratio`: disparities are scaled."""
    disparity = (pixels[:, 0] - pixels[:, 2]) * ratio
    return np.column_stack([pixels[:, :2], pixels[:, 0] - disparity]), np.asarray(sigmas_px * [1.0, abs(ratio)])
