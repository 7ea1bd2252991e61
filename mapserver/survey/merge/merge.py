"""Merging of a new survey's changes into the map, as one SurveyMap: all else stays to the bit."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.relocalization.landmark_visibility import Rows
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.finish.map_assembly import cut_patches, medoid_descriptors, point_information
from mapserver.survey.merge.base_map import BaseMap, as_recorded
from mapserver.survey.merge.guided_matching import Sighting
from mapserver.survey.merge.landmark_persistence import LandmarkCounts, missed_since
from mapserver.survey.state import Keyframe, Landmarks
from mapserver.survey.survey_map import History, SurveyMap


@dataclass(frozen=True, slots=True)
class Change:
    """Changes to a map of N landmarks and K keyframes.

    keep (N,): landmarks that stay; points_map (N, 3) and map_from_body (K, 4, 4): where they are from now on. added: landmarks
    that come, their observations by keyframes of the new survey (sorted by landmark); added_rows: which landmark of the map each
    takes the place of, with its id and descriptor, -1 for a new one.
    map_from_cam: of the new survey's keyframes.
    """

    keep: NDArray[np.bool_]
    points_map: Array
    map_from_body: Array
    added: Landmarks
    added_rows: Rows
    map_from_cam: Array


def resighted(base: BaseMap, rows: Rows, points_map: Array, sightings: Sequence[Sighting | None]) -> Landmarks:
    """Landmarks of the map as the new survey alone knows them: rows (R,) at points_map (R, 3) with their sightings."""
    number = np.full(len(base.points_map), -1)
    number[rows] = np.arange(len(rows))
    parts = [(k, s, number[s.rows] >= 0) for k, s in enumerate(sightings) if s is not None]
    if not parts:
        nothing = np.zeros(0, np.int32)
        return Landmarks(np.zeros((0, 3)), nothing, nothing, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))
    keyframe = np.concatenate([np.full(own.sum(), k) for k, _, own in parts])
    landmark = np.concatenate([number[s.rows[own]] for _, s, own in parts])
    order = np.lexsort((keyframe, landmark))
    features = np.concatenate([s.features[own] for _, s, own in parts])[order]
    pixels = np.concatenate([s.pixels[own] for _, s, own in parts])[order]
    sigmas_px = np.concatenate([s.sigmas_px[own] for _, s, own in parts])[order]
    numbers = (keyframe[order].astype(np.int32), landmark[order].astype(np.int32))
    return Landmarks(points_map, *numbers, features, pixels, sigmas_px)


def joined(first: Landmarks, second: Landmarks) -> Landmarks:
    """Both, the first ones first."""
    renumbered = replace(second, obs_landmark=second.obs_landmark + np.int32(len(first.points_map)))
    columns = ([getattr(part, field.name) for part in (first, renumbered)] for field in fields(Landmarks))
    return Landmarks(*(np.concatenate(column) for column in columns))


def chosen(marks: Landmarks, points_map: Array, keep: NDArray[np.bool_], free: NDArray[np.bool_]) -> Landmarks:
    """The landmarks `keep` (N,) of a survey at points_map (N, 3), with their observations that are `free` (M,)."""
    own = free & keep[marks.obs_landmark]
    number = (np.cumsum(keep) - 1).astype(np.int32)
    observations = (marks.obs_feature[own], marks.obs_pixels[own], marks.obs_sigma_px[own])
    return Landmarks(points_map[keep], marks.obs_keyframe[own], number[marks.obs_landmark[own]], *observations)


def fewer_keyframes(marks: Landmarks, enough: int) -> Landmarks:
    """The same landmarks with observations by fewer keyframes: taken in greedily until each has `enough`, or all it had."""
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


class SessionFrames(NamedTuple):
    """A survey's keyframes, the trajectory of all its frames (F) in `map`, and which of them were measured (F,)."""

    keyframes: list[Keyframe]
    trajectory: Trajectory
    estimated: NDArray[np.bool_]


def merged(
    base: BaseMap, change: Change, counts: LandmarkCounts, frames: SessionFrames, min_place_landmarks: int
) -> SurveyMap:
    """The next version's map. Keyframes that nothing is seen from any more go; new ones come where they see added landmarks."""
    old, added, keyframes = base.map, change.added, frames.keyframes
    keep_obs = change.keep[old.obs_landmark]
    old_used = np.bincount(old.obs_keyframe[keep_obs], minlength=len(old.map_from_body)) > 0
    per_keyframe = np.bincount(added.obs_keyframe, minlength=len(keyframes))
    new_used = np.flatnonzero(per_keyframe)
    old_number = np.cumsum(old_used) - 1
    new_number = np.full(len(keyframes), -1)
    new_number[new_used] = old_used.sum() + np.arange(len(new_used))
    landmark_number = np.cumsum(change.keep) - 1
    pixels, sigmas = as_recorded(base, added.obs_pixels, added.obs_sigma_px)
    octaves = [keyframes[k].features.octaves[f] for k, f in zip(added.obs_keyframe, added.obs_feature, strict=True)]
    rows, is_new = change.added_rows, change.added_rows < 0
    ids = np.where(is_new, base.history.next_landmark_id + np.cumsum(is_new) - 1, old.landmark_ids[rows])
    descriptors = medoid_descriptors(added, keyframes)
    descriptors[~is_new] = old.descriptors[rows[~is_new]]  # it is found by the old one, and robots have that
    cam_from_body = se3_inverse(old.body_from_cam)
    history = _history(base, change, counts, old_used, per_keyframe[new_used] >= min_place_landmarks, int(is_new.sum()))
    return SurveyMap(
        camera=old.camera,
        body_from_cam=old.body_from_cam,
        keyframe_stamps_ns=np.r_[old.keyframe_stamps_ns[old_used], [keyframes[k].stamp_ns for k in new_used]].astype(
            np.int64
        ),
        map_from_body=np.concatenate([change.map_from_body[old_used], change.map_from_cam[new_used] @ cam_from_body]),
        landmark_ids=np.r_[old.landmark_ids[change.keep], ids].astype(np.uint32),
        points_map=np.concatenate([change.points_map[change.keep], added.points_map]),
        descriptors=np.concatenate([old.descriptors[change.keep], descriptors]),
        point_sigma_m=np.r_[old.point_sigma_m[change.keep], _sigmas_m(base, change)],
        obs_keyframe=np.r_[old_number[old.obs_keyframe[keep_obs]], new_number[added.obs_keyframe]].astype(np.int32),
        obs_landmark=np.r_[landmark_number[old.obs_landmark[keep_obs]], change.keep.sum() + added.obs_landmark].astype(
            np.int32
        ),
        obs_pixels=np.concatenate([old.obs_pixels[keep_obs], pixels]),
        obs_octave=np.r_[old.obs_octave[keep_obs], np.array(octaves, np.int8)].astype(np.int8),
        obs_sigma_px=np.concatenate([old.obs_sigma_px[keep_obs], sigmas]),
        trajectory=frames.trajectory,
        trajectory_estimated=frames.estimated,
        patches=np.concatenate([old.patches[change.keep], cut_patches(added, keyframes)]),
        history=history,
    )


def _sigmas_m(base: BaseMap, change: Change) -> Array:
    marks = change.added
    cameras, has_depth = change.map_from_cam[marks.obs_keyframe], np.isfinite(marks.obs_pixels[:, 2])
    observations = (marks.obs_landmark, has_depth, marks.obs_sigma_px)
    information = point_information(base.camera, cameras, marks.points_map, *observations)
    return np.asarray(1.0 / np.sqrt(np.maximum(np.linalg.eigvalsh(information)[:, 0], 1e-6)))


def _history(
    base: BaseMap,
    change: Change,
    counts: LandmarkCounts,
    old_used: NDArray[np.bool_],
    new_places: NDArray[np.bool_],
    fresh: int,
) -> History:
    before, keep = base.history, change.keep
    came = np.zeros(len(change.added.points_map), np.uint32)
    new_ids = before.next_keyframe_id + np.arange(len(new_places))
    return History(
        keyframe_ids=np.r_[before.keyframe_ids[old_used], new_ids].astype(np.uint32),
        is_place=np.r_[before.is_place[old_used], new_places],
        landmark_expected=np.r_[(before.landmark_expected + counts.expected)[keep], came].astype(np.uint32),
        landmark_seen=np.r_[(before.landmark_seen + counts.seen)[keep], came].astype(np.uint32),
        landmark_missed=np.r_[missed_since(base, counts)[keep], came].astype(np.uint32),
        next_keyframe_id=before.next_keyframe_id + len(new_places),
        next_landmark_id=before.next_landmark_id + fresh,
    )
