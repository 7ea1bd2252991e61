"""Transformation of a finished survey to another frame."""

from dataclasses import replace

import numpy as np

from fleetmap.geometry import Array, se3_inverse, transform_points
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.state import SurveyState
from mapserver.survey.survey_map import SurveyMap


def transform_map(survey_map: SurveyMap, new_from_map: Array) -> SurveyMap:
    """Return the same survey in the frame `new`; new_from_map (4, 4) is rigid, so measurements are unchanged."""
    return replace(
        survey_map,
        map_from_body=new_from_map @ survey_map.map_from_body,
        points_map=transform_points(new_from_map, survey_map.points_map),
        trajectory=Trajectory(survey_map.trajectory.stamps_ns, new_from_map @ survey_map.trajectory.frame_from_body),
    )


def transform_state(state: SurveyState, new_from_map: Array) -> SurveyState:
    """Transform the adjusted state as `transform_map` does its map."""
    landmarks = replace(state.landmarks, points_map=transform_points(new_from_map, state.landmarks.points_map))
    return replace(state.moved(new_from_map @ state.map_from_body), landmarks=landmarks)


def scaled(survey_map: SurveyMap, scale: float) -> SurveyMap:
    """Return the same survey `scale` times as large, then in metres; the cameras' mount, already in metres, is unchanged."""
    frames = _grown(survey_map.trajectory.frame_from_body, survey_map.body_from_cam, scale)
    return replace(
        survey_map,
        map_from_body=_grown(survey_map.map_from_body, survey_map.body_from_cam, scale),
        points_map=scale * survey_map.points_map,
        point_sigma_m=scale * survey_map.point_sigma_m,
        trajectory=Trajectory(survey_map.trajectory.stamps_ns, frames),
        scale_known=True,
    )


def scaled_state(state: SurveyState, scale: float) -> SurveyState:
    """Scale the adjusted state as `scaled` does its map."""
    return replace(
        state,
        map_from_body=_grown(state.map_from_body, state.rig.body_from_cam[0], scale),
        landmarks=replace(state.landmarks, points_map=scale * state.landmarks.points_map),
    )


def _grown(map_from_body: Array, body_from_cam: Array, scale: float) -> Array:
    map_from_cam = map_from_body @ body_from_cam
    map_from_cam[:, :3, 3] *= scale
    return np.asarray(map_from_cam @ se3_inverse(body_from_cam))
