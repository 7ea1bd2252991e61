"""The map of a survey: keyframes, landmarks, observations, and the trajectory of all frames."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.geometry import Array, Mask, transform_points
from fleetmap.relocalization.map_view import ViewingCones
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Stamps, Trajectory
from mapserver.survey.rig import scaled_bodies


@dataclass(frozen=True, slots=True)
class History:
    """History of K keyframes and N landmarks over the versions of a site. Ids are never reused.

    keyframe_ids (K,); is_place (K,): True for keyframes used as places by robots. landmark_expected, landmark_seen (N,): numbers of
    keyframes of later surveys that should have seen the landmark, and did; landmark_missed (N,): misses since it was last seen.
    """

    keyframe_ids: NDArray[np.uint32]
    is_place: Mask
    landmark_expected: NDArray[np.uint32]
    landmark_seen: NDArray[np.uint32]
    landmark_missed: NDArray[np.uint32]
    next_keyframe_id: int
    next_landmark_id: int


@dataclass(frozen=True, slots=True)
class SurveyMap:
    """A finished survey in `map`; K keyframes, N landmarks, M observations, F selected frames.

    map_from_body (K, 4, 4). points_map (N, 3), descriptors (N, 32) uint8, point_sigma_m (N,) largest standard deviation. obs_keyframe and
    obs_landmark (M,) index the arrays here; obs_pixels (M, 3) is u_left, v, u_right (NaN without a right match); obs_sigma_px (M, 2) of u
    and v, and of the disparity; the first observation of each landmark is its reference. trajectory has all F frames; if
    trajectory_estimated (F,) is False the pose is interpolated between neighbours. patches (N, P, P) uint8 are cut from each landmark's
    reference keyframe at its octave. history: None for a survey not compared with another yet. scale_known is False for one camera's
    map with an arbitrary scale.
    """

    camera: StereoCamera
    body_from_cam: Array
    keyframe_stamps_ns: Stamps
    map_from_body: Array
    landmark_ids: NDArray[np.uint32]
    points_map: Array
    descriptors: NDArray[np.uint8]
    point_sigma_m: Array
    obs_keyframe: NDArray[np.int32]
    obs_landmark: NDArray[np.int32]
    obs_pixels: Array
    obs_octave: NDArray[np.int8]
    obs_sigma_px: Array
    trajectory: Trajectory
    trajectory_estimated: Mask
    patches: NDArray[np.uint8]
    history: History | None = None
    scale_known: bool = True

    @property
    def estimated_trajectory(self) -> Trajectory:
        """The selected frames whose poses are measured in the map."""
        chosen = self.trajectory_estimated
        return Trajectory(self.trajectory.stamps_ns[chosen], self.trajectory.frame_from_body[chosen])

    def transformed(self, new_from_map: Array) -> "SurveyMap":
        """Return the same survey in another frame; new_from_map (4, 4) is rigid, so measurements are unchanged."""
        return replace(
            self,
            map_from_body=new_from_map @ self.map_from_body,
            points_map=transform_points(new_from_map, self.points_map),
            trajectory=Trajectory(self.trajectory.stamps_ns, new_from_map @ self.trajectory.frame_from_body),
        )

    def scaled(self, scale: float) -> "SurveyMap":
        """Return the same survey `scale` times as large, then in metres; the cameras' mount, already in metres, is unchanged."""
        frames = scaled_bodies(self.trajectory.frame_from_body, self.body_from_cam, scale)
        return replace(
            self,
            map_from_body=scaled_bodies(self.map_from_body, self.body_from_cam, scale),
            points_map=scale * self.points_map,
            point_sigma_m=scale * self.point_sigma_m,
            trajectory=Trajectory(self.trajectory.stamps_ns, frames),
            scale_known=True,
        )


def history_of(survey_map: SurveyMap) -> History:
    """Return its history; for a survey without one, that of a map without later surveys."""
    if survey_map.history is not None:
        return survey_map.history
    keyframes, landmarks = len(survey_map.map_from_body), len(survey_map.landmark_ids)
    never = np.zeros(landmarks, np.uint32)
    return History(
        keyframe_ids=np.arange(keyframes, dtype=np.uint32),
        is_place=np.ones(keyframes, np.bool_),
        landmark_expected=never,
        landmark_seen=never.copy(),
        landmark_missed=never.copy(),
        next_keyframe_id=keyframes,
        next_landmark_id=int(survey_map.landmark_ids.max(initial=0)) + 1 if landmarks else 0,
    )


def viewing_cones(survey: SurveyMap, map_from_cam: Array) -> ViewingCones:
    """Return whence a survey's landmarks (N) were seen, with its keyframes' cameras at map_from_cam (K, 4, 4).

    Directions: mean of those to the cameras; half angles: largest angle to it; distances: median over observations of
    distance * scale ** octave. Half angle and distance are 0 for a landmark without observations.
    Source: Mur-Artal et al. 2015 (ORB-SLAM), section III.C.
    """
    landmark, count = survey.obs_landmark, len(survey.landmark_ids)
    offsets_map = map_from_cam[survey.obs_keyframe, :3, 3] - survey.points_map[landmark]
    distances_m = np.linalg.norm(offsets_map, axis=1)
    rays_map = offsets_map / np.maximum(distances_m, 1e-9)[:, None]
    counts = np.bincount(landmark, minlength=count)
    directions_map = _mean_directions(landmark, rays_map, counts)
    cosines = np.einsum("ij,ij->i", rays_map, directions_map[landmark])
    half_angles_rad = np.zeros(count)
    np.maximum.at(half_angles_rad, landmark, np.arccos(np.clip(cosines, -1.0, 1.0)))
    max_distances_m = _medians(landmark, distances_m * SCALE_FACTOR**survey.obs_octave, counts)
    rounded = (values.astype(np.float32) for values in (directions_map, half_angles_rad, max_distances_m))
    return ViewingCones(survey.points_map, *rounded)


def _mean_directions(landmark: NDArray[np.int32], rays_map: Array, counts: NDArray[np.intp]) -> Array:
    sums = np.stack([np.bincount(landmark, rays_map[:, axis], len(counts)) for axis in range(3)], axis=1)
    # Seen from opposite sides the mean is zero; any direction will do, the half angle then includes all others.
    vague = np.linalg.norm(sums, axis=1) < 1e-6 * np.maximum(counts, 1)
    first_seen = np.unique(landmark, return_index=True)
    fallback = np.tile([0.0, 0.0, 1.0], (len(counts), 1))
    fallback[first_seen[0]] = rays_map[first_seen[1]]
    sums[vague] = fallback[vague]
    return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True))


def _medians(groups: NDArray[np.int32], values: Array, counts: NDArray[np.intp]) -> Array:
    """Return (N,) median (the upper of two middle ones) of the values of each group, 0 for empty ones."""
    ordered = values[np.lexsort((values, groups))]
    starts = np.cumsum(counts) - counts
    medians = np.zeros(len(counts))
    filled = counts > 0
    medians[filled] = ordered[(starts + counts // 2)[filled]]
    return medians
