"""Merge of a new survey's changes into the map, as one SurveyMap: all else is bit-identical."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array, se3_inverse
from fleetmap.relocalization.landmark_visibility import Rows
from mapserver.survey.finish.map_assembly import cut_patches, medoid_descriptors, point_information
from mapserver.survey.merge.base_map import BaseMap, as_recorded
from mapserver.survey.merge.landmark_persistence import LandmarkCounts, missed_since
from mapserver.survey.state import Keyframe, Landmarks
from mapserver.survey.survey_map import History, SurveyMap


@dataclass(frozen=True, slots=True)
class Change:
    """Changes to a map of N landmarks and K keyframes.

    keep (N,): landmarks that stay; points_map (N, 3) and map_from_body (K, 4, 4): their new positions and poses. added: new landmarks,
    their observations by keyframes of the new survey (sorted by landmark); added_rows: the landmark of the map replaced by each, whose id
    and descriptor it takes, -1 for a new one, which is added_own of the new survey's. map_from_cam: of the new survey's keyframes.
    """

    keep: NDArray[np.bool_]
    points_map: Array
    map_from_body: Array
    added: Landmarks
    added_rows: Rows
    added_own: Rows
    map_from_cam: Array


def merged(
    base: BaseMap, change: Change, counts: LandmarkCounts, keyframes: list[Keyframe], min_place_landmarks: int
) -> SurveyMap:
    """Return the next version's map, with the old trajectory. Keyframes without landmarks are removed; new ones are added if they see
    added landmarks.
    """
    old, added, before, keep = base.map, change.added, base.history, change.keep
    keep_obs = keep[old.obs_landmark]
    old_used = np.bincount(old.obs_keyframe[keep_obs], minlength=len(old.map_from_body)) > 0
    per_keyframe = np.bincount(added.obs_keyframe, minlength=len(keyframes))
    new_used = np.flatnonzero(per_keyframe)
    old_number = np.cumsum(old_used) - 1
    new_number = np.full(len(keyframes), -1)
    new_number[new_used] = old_used.sum() + np.arange(len(new_used))
    landmark_number = np.cumsum(keep) - 1
    pixels, sigmas = as_recorded(base, added.obs_pixels, added.obs_sigma_px)
    rows, is_new = change.added_rows, change.added_rows < 0
    ids = np.where(is_new, before.next_landmark_id + np.cumsum(is_new) - 1, old.landmark_ids[rows])
    descriptors = medoid_descriptors(added, keyframes)
    descriptors[~is_new] = old.descriptors[rows[~is_new]]  # robots match and already have the old one
    cameras, has_depth = change.map_from_cam[added.obs_keyframe], np.isfinite(added.obs_pixels[:, 2])
    observations = (added.obs_landmark, has_depth, added.obs_sigma_px)
    information = point_information(base.camera, cameras, added.points_map, *observations)
    sigmas_m = 1.0 / np.sqrt(np.maximum(np.linalg.eigvalsh(information)[:, 0], 1e-6))
    came = np.zeros(len(added.points_map), np.uint32)
    history = History(
        keyframe_ids=_joined(before.keyframe_ids[old_used], before.next_keyframe_id + np.arange(len(new_used))),
        is_place=np.r_[before.is_place[old_used], per_keyframe[new_used] >= min_place_landmarks],
        landmark_expected=_joined((before.landmark_expected + counts.expected)[keep], came),
        landmark_seen=_joined((before.landmark_seen + counts.seen)[keep], came),
        landmark_missed=_joined(missed_since(base, counts)[keep], came),
        next_keyframe_id=before.next_keyframe_id + len(new_used),
        next_landmark_id=before.next_landmark_id + int(is_new.sum()),
    )
    new_stamps_ns = np.array([keyframes[k].stamp_ns for k in new_used], np.int64)
    new_from_body = change.map_from_cam[new_used] @ se3_inverse(old.body_from_cam)
    new_landmarks = keep.sum() + added.obs_landmark
    return replace(
        old,
        keyframe_stamps_ns=np.concatenate([old.keyframe_stamps_ns[old_used], new_stamps_ns]),
        map_from_body=np.concatenate([change.map_from_body[old_used], new_from_body]),
        landmark_ids=_joined(old.landmark_ids[keep], ids),
        points_map=np.concatenate([change.points_map[keep], added.points_map]),
        descriptors=np.concatenate([old.descriptors[keep], descriptors]),
        point_sigma_m=np.r_[old.point_sigma_m[keep], sigmas_m],
        obs_keyframe=np.r_[old_number[old.obs_keyframe[keep_obs]], new_number[added.obs_keyframe]].astype(np.int32),
        obs_landmark=np.r_[landmark_number[old.obs_landmark[keep_obs]], new_landmarks].astype(np.int32),
        obs_pixels=np.concatenate([old.obs_pixels[keep_obs], pixels]),
        obs_octave=np.concatenate(
            [old.obs_octave[keep_obs], added.of_features([k.features.octaves for k in keyframes])]
        ),
        obs_sigma_px=np.concatenate([old.obs_sigma_px[keep_obs], sigmas]),
        patches=np.concatenate([old.patches[keep], cut_patches(added, keyframes)]),
        history=history,
    )


def _joined(old: AnyArray, new: AnyArray) -> NDArray[np.uint32]:
    return np.concatenate([old, new]).astype(np.uint32)
