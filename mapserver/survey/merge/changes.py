"""Changes of a map by a survey: moved keyframes and landmarks, and new landmarks."""

from dataclasses import dataclass, replace

import numpy as np

from fleetmap.geometry import Array, Mask, Rings, inside_any, se3_inverse
from fleetmap.relocalization.map_view import COLUMNS, ROWS, Rows, image_cells
from mapserver.survey.finish.map_assembly import parallax_rad
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.guided_matching import Sightings
from mapserver.survey.merge.joint_adjustment import JointSolution, free_observations
from mapserver.survey.merge.landmark_persistence import Shift, shifts
from mapserver.survey.merge.merge import Change
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999
from mapserver.survey.settings import SessionSettings, SurveySettings
from mapserver.survey.stages import Survey
from mapserver.survey.state import Landmarks, RigImages

_CELLS = COLUMNS * ROWS
_MIN_IN_CELL = 3  # fewer confirmed landmarks do not prove a gap in the map
_LACKING_SHARE = 0.6
_CLOCKS_BEGIN_NS = 946_684_800_000_000_000  # the year 2000: earlier stamps count from a start, not from 1970


@dataclass(frozen=True, slots=True)
class SurveyLimits:
    """Polygons of a published map in which operators limit what surveys change.

    frozen: neither add, move nor remove landmarks, nor move or add places. unused: add no landmarks. since: add no landmarks if the
    survey ended before a time, in nanoseconds since 1970.
    """

    frozen: tuple[Rings, ...] = ()
    unused: tuple[Rings, ...] = ()
    since: tuple[tuple[Rings, int], ...] = ()

    def freezes(self, points_map: Array) -> Mask:
        """Return (N,) which points (N, 3) lie in a frozen polygon."""
        return inside_any(points_map, self.frozen)

    def closes(self, points_map: Array, end_ns: int) -> Mask:
        """Return (N,) where a survey that ended at end_ns by its own clock may not add landmarks."""
        late = [rings for rings, since_ns in self.since if is_before(end_ns, since_ns)]
        return inside_any(points_map, (*self.frozen, *self.unused, *late))


def is_before(end_ns: int, since_ns: int) -> bool:
    """True if a recording's last stamp precedes a time; a clock that does not count from 1970 cannot tell."""
    return _CLOCKS_BEGIN_NS < end_ns < since_ns


def what_changes(
    base: BaseMap,
    survey: Survey,
    posed: RigImages,
    joint: JointSolution,
    gone: Mask,
    settings: SurveySettings,
    limits: SurveyLimits,
) -> tuple[Change, int, int]:
    """Return the change, and how many keyframes and landmarks of the map moved. gone (N,): faded landmarks.

    posed: the survey's images after the joint adjustment, which become keyframes of the map.
    """
    marks, map_from_cam = survey.state.landmarks.by_image(posed.numbers), posed.map_from_cam
    moved_keyframes = np.zeros(len(base.map_from_cam), bool)
    moved_keyframes[joint.base_keyframes] = _keyframes_moved(base, joint, settings.sessions)
    moved_keyframes &= ~limits.freezes(base.map_from_cam[:, :3, 3])
    cameras = base.map_from_cam.copy()
    cameras[joint.base_keyframes] = joint.base_from_body @ posed.rig.body_from_cam[0]
    judged = shifts(base, map_from_cam, joint.sightings, settings)
    points, moved = _moved_points(base, joint, judged, moved_keyframes, cameras)
    frozen = limits.freezes(base.points_map)
    points[frozen], moved[frozen] = base.points_map[frozen], False
    alone = judged.significant & ~moved[judged.rows] & ~gone[judged.rows] & ~frozen[judged.rows]
    keep = ~gone
    keep[judged.rows[alone]] = False
    free = free_observations(marks, joint.sightings)
    fresh = _new_landmarks(base, marks, joint, free, settings.sessions)
    fresh &= known_well(survey, joint, settings)
    fresh &= ~limits.closes(joint.own_points_map, int(survey.map.trajectory.stamps_ns[-1]))
    again = _resighted(base, judged.rows[alone], judged.points_map[alone], joint.sightings)
    own = free & fresh[marks.obs_landmark]
    number = len(again.points_map) + np.cumsum(fresh) - 1
    points_map = np.concatenate([again.points_map, joint.own_points_map[fresh]])
    new = marks.taken(own, points_map, marks.obs_keyframe[own], number[marks.obs_landmark[own]])
    added = fewer_keyframes(Landmarks.concatenated(points_map, [again, new]), settings.sessions.min_confirmations)
    rows = np.r_[judged.rows[alone], np.full(fresh.sum(), -1)]
    places = base.map.map_from_body.copy()
    places[moved_keyframes] = cameras[moved_keyframes] @ se3_inverse(base.map.body_from_cam)
    numbers = np.r_[np.full(alone.sum(), -1), np.flatnonzero(fresh)]
    change = Change(keep, points, places, added, rows, numbers, map_from_cam)
    return change, int(moved_keyframes.sum()), int(alone.sum() + (moved & keep).sum())


def known_well(survey: Survey, joint: JointSolution, settings: SurveySettings) -> Mask:
    """Return (N,) own landmarks of the survey with enough parallax, as required of landmarks in a map."""
    took_part = np.isfinite(joint.own_points_map).all(axis=1)
    marks = replace(survey.state.landmarks, points_map=np.nan_to_num(joint.own_points_map))
    placed = replace(survey.state, map_from_body=joint.map_from_body, landmarks=marks)
    return np.asarray(took_part & (parallax_rad(placed) >= np.radians(settings.cull.min_parallax_deg)))


def _keyframes_moved(base: BaseMap, joint: JointSolution, settings: SessionSettings) -> Mask:
    """Return (B,) keyframes of the map that the new survey moved: those of a published one by more than their anchors allow."""
    if not joint.measured.is_anchored:
        return np.ones(len(joint.base_keyframes), bool)
    before = base.map_from_body[joint.base_keyframes]
    shift_m = np.linalg.norm(joint.base_from_body[:, :3, 3] - before[:, :3, 3], axis=1)
    turns = joint.base_from_body[:, :3, :3] @ before[:, :3, :3].transpose(0, 2, 1)
    angle = np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))
    squared = (shift_m / settings.anchor_sigma_m) ** 2 + (angle / np.radians(settings.anchor_sigma_deg)) ** 2
    return np.asarray(squared > CHI2_6_0999)


def _moved_points(
    base: BaseMap, joint: JointSolution, judged: Shift, moved_keyframes: Mask, cameras: Array
) -> tuple[Array, Mask]:
    """Return the positions of the map's landmarks (N, 3), and which (N,) moved with their keyframes.

    Seen ones are at their adjusted positions, the others move with the keyframe of their patch; in a published
    map, seen landmarks without significant motion are unchanged.
    """
    points, references = base.points_map.copy(), base.map.obs_keyframe[base.references]
    moved = moved_keyframes[references] & (base.references >= 0)
    if joint.measured.is_anchored:
        moved[judged.rows[~judged.significant]] = False
    rigid = cameras[references[moved]] @ se3_inverse(base.map_from_cam[references[moved]])
    points[moved] = np.einsum("nij,nj->ni", rigid[:, :3, :3], base.points_map[moved]) + rigid[:, :3, 3]
    seen = joint.base_rows[moved[joint.base_rows]]
    points[seen] = joint.base_points_map[moved[joint.base_rows]]
    return points, moved


def _new_landmarks(
    base: BaseMap, marks: Landmarks, joint: JointSolution, free: Mask, settings: SessionSettings
) -> Mask:
    """Return (N,) own landmarks of the survey to add to the map; free (M,): observations that show none of the map's.

    A part of a picture (one of 48) is covered if at least `covered_share` as many landmarks of the map are seen in it
    as new ones; a landmark is new if most of its parts are not covered.
    """
    counts = np.bincount(marks.obs_landmark[free], minlength=len(marks.points_map))
    confirmed = (counts >= settings.min_confirmations) & np.isfinite(joint.own_points_map).all(axis=1)
    chosen, seen = free & confirmed[marks.obs_landmark], joint.sightings
    part = _CELLS * marks.obs_keyframe + image_cells(marks.obs_pixels[:, :2], base.camera)
    fresh, known = (
        np.bincount(parts, minlength=_CELLS * len(seen.located))
        for parts in (part[chosen], _CELLS * seen.image + image_cells(seen.pixels[:, :2], base.camera))
    )
    bare = (fresh >= _MIN_IN_CELL) & (known <= settings.covered_share * fresh)
    lacking = chosen & (bare[part] | ~seen.located[marks.obs_keyframe])
    share = np.bincount(marks.obs_landmark[lacking], minlength=len(counts)) / np.maximum(counts, 1)
    return np.asarray(confirmed & (share >= _LACKING_SHARE))


def _resighted(base: BaseMap, rows: Rows, points_map: Array, sightings: Sightings) -> Landmarks:
    """Return landmarks of the map by the new survey alone: rows (R,) at points_map (R, 3) with their sightings."""
    number = np.full(len(base.points_map), -1)
    number[rows] = np.arange(len(rows))
    seen = sightings.only(number[sightings.rows] >= 0)
    order = np.lexsort((seen.image, number[seen.rows]))
    owners = seen.image[order], np.zeros(len(order)), number[seen.rows[order]], seen.features[order]
    images, cameras, landmarks, features = (column.astype(np.int32) for column in owners)
    return Landmarks(points_map, images, cameras, landmarks, features, seen.pixels[order], seen.sigmas_px[order])


def fewer_keyframes(marks: Landmarks, enough: int) -> Landmarks:
    """Return the same landmarks with observations by fewer keyframes: chosen greedily until each has `enough`, or all it had."""
    needed = np.minimum(np.bincount(marks.obs_landmark, minlength=len(marks.points_map)), enough)
    taken: list[int] = []
    left = np.unique(marks.obs_keyframe).tolist()
    rows = {k: np.flatnonzero(marks.obs_keyframe == k) for k in left}
    while needed.any():
        best = max(left, key=lambda k: (int((needed[marks.obs_landmark[rows[k]]] > 0).sum()), -k))
        needed[marks.obs_landmark[rows[best]]] = np.maximum(needed[marks.obs_landmark[rows[best]]] - 1, 0)
        taken.append(best)
        left.remove(best)
    return marks.keep_observations(np.isin(marks.obs_keyframe, taken), 1)
