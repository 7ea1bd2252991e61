"""A finished survey in another frame."""

from dataclasses import replace

from fleetmap.geometry import Array, transform_points
from fleetmap.samples import Trajectory
from mapserver.survey.result import SurveyMap


def moved(survey_map: SurveyMap, new_from_map: Array) -> SurveyMap:
    """The same survey in the frame `new`; new_from_map (4, 4) is rigid, so nothing measured changes."""
    return replace(
        survey_map,
        map_from_body=new_from_map @ survey_map.map_from_body,
        points_map=transform_points(new_from_map, survey_map.points_map),
        trajectory=Trajectory(survey_map.trajectory.stamps_ns, new_from_map @ survey_map.trajectory.frame_from_body),
    )
