"""Merge of a new survey's changes into the map, as one SurveyMap: all else is bit-identical."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array, Mask, se3_inverse
from fleetmap.relocalization.map_view import Rows
from mapserver.survey.finish.map_assembly import cut_patches, medoid_descriptors, point_sigmas_m
from mapserver.survey.merge.base_map import BaseMap, with_baseline
from mapserver.survey.merge.landmark_persistence import LandmarkCounts, missed_since
from mapserver.survey.state import Keyframe, Landmarks
from mapserver.survey.survey_map import History, SurveyMap, history_of

_OF_LANDMARKS = ("landmark_ids", "points_map", "descriptors", "point_sigma_m", "patches")
_OF_OBSERVATIONS = ("obs_pixels", "obs_octave", "obs_sigma_px")


@dataclass(frozen=True, slots=True)
class Change:
    """Changes to a map of N landmarks and K keyframes.

    keep (N,): landmarks that stay; points_map (N, 3) and map_from_body (K, 4, 4): their new positions and poses. added: new landmarks,
    their observations by keyframes of the new survey (sorted by landmark); added_rows: the landmark of the map replaced by each, whose id
    and descriptor it takes, -1 for a new one, which is added_own of the new survey's. map_from_cam: of the new survey's keyframes.
    """

    keep: Mask
    points_map: Array
    map_from_body: Array
    added: Landmarks
    added_rows: Rows
    added_own: Rows
    map_from_cam: Array


def merged(
    base: BaseMap,
    change: Change,
    counts: LandmarkCounts,
    keyframes: list[Keyframe],
    min_place_landmarks: int,
    no_place: Mask | bool = False,
) -> SurveyMap:
    """Return the next version's map, with the old trajectory. Keyframes without landmarks are removed; new ones are added if they see
    added landmarks. no_place: those of the new survey's keyframes (K,) that are no places for robots.
    """
    added, keep = change.added, change.keep
    old = kept(replace(base.map, points_map=change.points_map, map_from_body=change.map_from_body), keep)
    before, whole = history_of(old), base.history
    per_keyframe = np.bincount(added.obs_keyframe, minlength=len(keyframes))
    new_used = np.flatnonzero(per_keyframe)
    new_number = np.full(len(keyframes), -1)
    new_number[new_used] = len(old.map_from_body) + np.arange(len(new_used))
    # As the camera that made the map would see them.
    pixels, sigmas = with_baseline(added.obs_pixels, added.obs_sigma_px, 1.0 / base.baseline_ratio)
    rows, is_new = change.added_rows, change.added_rows < 0
    ids = np.where(is_new, whole.next_landmark_id + np.cumsum(is_new) - 1, base.map.landmark_ids[rows])
    descriptors = medoid_descriptors(added, keyframes)
    descriptors[~is_new] = base.descriptors[rows[~is_new]]  # robots match and already have the old one
    sigmas_m = point_sigmas_m(base.camera, change.map_from_cam, added)
    offered = (per_keyframe >= min_place_landmarks) & ~np.asarray(no_place)
    came = np.zeros(len(added.points_map), np.uint32)
    history = History(
        keyframe_ids=_joined(before.keyframe_ids, whole.next_keyframe_id + np.arange(len(new_used))),
        is_place=np.r_[before.is_place, offered[new_used]],
        landmark_expected=_joined(before.landmark_expected + counts.expected[keep], came),
        landmark_seen=_joined(before.landmark_seen + counts.seen[keep], came),
        landmark_missed=_joined(missed_since(base, counts)[keep], came),
        next_keyframe_id=whole.next_keyframe_id + len(new_used),
        next_landmark_id=whole.next_landmark_id + int(is_new.sum()),
    )
    new_stamps_ns = np.array([keyframes[k].stamp_ns for k in new_used], np.int64)
    new_from_body = change.map_from_cam[new_used] @ se3_inverse(old.body_from_cam)
    new_landmarks = len(old.landmark_ids) + added.obs_landmark
    return replace(
        old,
        keyframe_stamps_ns=np.concatenate([old.keyframe_stamps_ns, new_stamps_ns]),
        map_from_body=np.concatenate([old.map_from_body, new_from_body]),
        landmark_ids=_joined(old.landmark_ids, ids),
        points_map=np.concatenate([old.points_map, added.points_map]),
        descriptors=np.concatenate([old.descriptors, descriptors]),
        point_sigma_m=np.r_[old.point_sigma_m, sigmas_m],
        obs_keyframe=np.r_[old.obs_keyframe, new_number[added.obs_keyframe]].astype(np.int32),
        obs_landmark=np.r_[old.obs_landmark, new_landmarks].astype(np.int32),
        obs_pixels=np.concatenate([old.obs_pixels, pixels]),
        obs_octave=np.concatenate([old.obs_octave, added.of_features([k.features.octaves for k in keyframes])]),
        obs_sigma_px=np.concatenate([old.obs_sigma_px, sigmas]),
        patches=np.concatenate([old.patches, cut_patches(added, keyframes)]),
        history=history,
    )


def kept(survey_map: SurveyMap, keep: Mask) -> SurveyMap:
    """Return the map with some of its landmarks (N,), without the keyframes that saw no others; all else is bit-identical."""
    history, keep_obs = history_of(survey_map), keep[survey_map.obs_landmark]
    used = np.bincount(survey_map.obs_keyframe[keep_obs], minlength=len(survey_map.map_from_body)) > 0
    of_landmarks = ("landmark_expected", "landmark_seen", "landmark_missed")
    return replace(
        survey_map,
        **{name: getattr(survey_map, name)[used] for name in ("keyframe_stamps_ns", "map_from_body")},
        **{name: getattr(survey_map, name)[keep] for name in _OF_LANDMARKS},
        **{name: getattr(survey_map, name)[keep_obs] for name in _OF_OBSERVATIONS},
        obs_keyframe=(np.cumsum(used) - 1)[survey_map.obs_keyframe[keep_obs]].astype(np.int32),
        obs_landmark=(np.cumsum(keep) - 1)[survey_map.obs_landmark[keep_obs]].astype(np.int32),
        history=replace(
            history,
            keyframe_ids=history.keyframe_ids[used],
            is_place=history.is_place[used],
            **{name: getattr(history, name)[keep] for name in of_landmarks},
        ),
    )


def _joined(old: AnyArray, new: AnyArray) -> NDArray[np.uint32]:
    return np.concatenate([old, new]).astype(np.uint32)
