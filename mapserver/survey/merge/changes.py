"""Changes of a map by a survey: keyframes and landmarks that moved, landmarks that stand elsewhere or are new."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from mapserver.survey.finish.culling import parallax_rad
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.joint_adjustment import JointSolution, free_observations
from mapserver.survey.merge.landmark_persistence import Shift, shifts
from mapserver.survey.merge.merge import Change, chosen, fewer_keyframes, joined, resighted
from mapserver.survey.merge.new_landmarks import new_landmarks
from mapserver.survey.settings import SessionSettings, SurveySettings
from mapserver.survey.stages import Survey

_KEYFRAME_MOVED = 22.458  # 0.999 of chi-square with 6 degrees of freedom
Mask = NDArray[np.bool_]


def what_changes(
    base: BaseMap, survey: Survey, joint: JointSolution, gone: Mask, settings: SurveySettings, *, anchored: bool
) -> tuple[Change, int, int]:
    """The change, and how many keyframes and landmarks of the map moved. gone (N,): landmarks that have faded."""
    marks, body_from_cam = survey.state.landmarks, survey.state.body_from_cam
    map_from_cam = joint.map_from_body @ body_from_cam
    moved_keyframes = np.zeros(len(base.map_from_cam), bool)
    moved_keyframes[joint.base_keyframes] = _keyframes_moved(base, joint, settings.sessions) if anchored else True
    cameras = base.map_from_cam.copy()
    cameras[joint.base_keyframes] = joint.base_from_body @ body_from_cam
    judged = shifts(base, map_from_cam, joint.sightings, settings)
    points, moved = _moved_points(base, joint, judged, moved_keyframes, cameras, anchored=anchored)
    alone = judged.significant & ~moved[judged.rows] & ~gone[judged.rows]
    keep = ~gone
    keep[judged.rows[alone]] = False
    free = free_observations(marks, joint.sightings)
    fresh = new_landmarks(base, survey.odometry.keyframes, marks, joint, free, settings.sessions)
    fresh &= known_well(survey, joint, settings)
    again = resighted(base, judged.rows[alone], judged.points_map[alone], joint.sightings)
    new = chosen(marks, joint.own_points_map, fresh, free)
    added = fewer_keyframes(joined(again, new), settings.sessions.min_confirmations)
    rows = np.r_[judged.rows[alone], np.full(fresh.sum(), -1)]
    places = base.map.map_from_body.copy()
    places[moved_keyframes] = cameras[moved_keyframes] @ se3_inverse(base.map.body_from_cam)
    change = Change(keep, points, places, added, rows, map_from_cam)
    return change, int(moved_keyframes.sum()), int(alone.sum() + (moved & keep).sum())


def known_well(survey: Survey, joint: JointSolution, settings: SurveySettings) -> Mask:
    """(N,) own landmarks of the survey that are seen under an angle that places them, as a survey demands of those it hands on."""
    took_part = np.isfinite(joint.own_points_map).all(axis=1)
    marks = replace(survey.state.landmarks, points_map=np.nan_to_num(joint.own_points_map))
    placed = replace(survey.state, map_from_body=joint.map_from_body, landmarks=marks)
    return np.asarray(took_part & (parallax_rad(placed) >= np.radians(settings.cull.min_parallax_deg)))


def _keyframes_moved(base: BaseMap, joint: JointSolution, settings: SessionSettings) -> Mask:
    """(B,) keyframes of the map that the new survey moved by more than their anchors admit."""
    before = base.map_from_body[joint.base_keyframes]
    shift_m = np.linalg.norm(joint.base_from_body[:, :3, 3] - before[:, :3, 3], axis=1)
    turns = joint.base_from_body[:, :3, :3] @ before[:, :3, :3].transpose(0, 2, 1)
    angle = np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))
    squared = (shift_m / settings.anchor_sigma_m) ** 2 + (angle / np.radians(settings.anchor_sigma_deg)) ** 2
    return np.asarray(squared > _KEYFRAME_MOVED)


def _moved_points(
    base: BaseMap, joint: JointSolution, judged: Shift, moved_keyframes: Mask, cameras: Array, *, anchored: bool
) -> tuple[Array, Mask]:
    """Where the map's landmarks (N, 3) are, and which (N,) moved with the keyframes that saw them.

    Seen ones go where the adjustment put them, the others with the keyframe that their patch was cut from; in a published
    map what was seen and did not move significantly stays.
    """
    points, references = base.points_map.copy(), base.map.obs_keyframe[base.references]
    moved = moved_keyframes[references] & (base.references >= 0)
    if anchored:
        moved[judged.rows[~judged.significant]] = False
    rigid = cameras[references[moved]] @ se3_inverse(base.map_from_cam[references[moved]])
    points[moved] = np.einsum("nij,nj->ni", rigid[:, :3, :3], base.points_map[moved]) + rigid[:, :3, 3]
    seen = joint.base_rows[moved[joint.base_rows]]
    points[seen] = joint.base_points_map[moved[joint.base_rows]]
    return points, moved
