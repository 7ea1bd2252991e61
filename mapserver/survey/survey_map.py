"""The map of a survey: keyframes, landmarks, observations, and the trajectory of all frames."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, transform_points
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
    is_place: NDArray[np.bool_]
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
    trajectory_estimated: NDArray[np.bool_]
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
