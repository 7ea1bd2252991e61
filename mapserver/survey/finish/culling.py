"""Culling of a finished survey: duplicate or inaccurate landmarks, redundant keyframes."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fleetmap import core
from fleetmap.features.matching import packed
from fleetmap.geometry import Array
from mapserver.survey.settings import CullSettings
from mapserver.survey.state import Keyframe, Landmarks, SurveyState


@dataclass(frozen=True, slots=True)
class Culled:
    """Numbers of removed items: landmarks_merged into another, landmarks_weak, redundant keyframes."""

    landmarks_merged: int = 0
    landmarks_weak: int = 0
    keyframes_redundant: int = 0


def cull(
    state: SurveyState, keyframes: list[Keyframe], sigmas_m: Array, settings: CullSettings
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Culled]:
    """Return the kept observations (M,) and keyframes (K,) of a single camera, and the removed ones; `state` is unchanged.

    sigmas_m (N,) of the landmarks.
    """
    marks = state.landmarks
    octaves = marks.of_features([k.features.octaves for k in keyframes]).astype(np.int64)
    double = _duplicates(marks, keyframes, sigmas_m, settings)
    weak = ~double & (parallax_rad(state) < np.radians(settings.min_parallax_deg))
    lasting = ~(double | weak)
    superfluous = redundant(marks, octaves, lasting, len(keyframes), settings)
    keep = lasting[marks.obs_landmark] & ~superfluous[marks.obs_keyframe]
    return keep, ~superfluous, Culled(int(double.sum()), int(weak.sum()), int(superfluous.sum()))


def parallax_rad(state: SurveyState) -> Array:
    """Return (N,) the parallax angle of each landmark's observations: largest between any and the first, or across the baseline."""
    marks = state.landmarks
    centres = state.map_from_cams[marks.obs_keyframe, marks.obs_camera, :3, 3]
    rays = centres - marks.points_map[marks.obs_landmark]
    distances = np.maximum(np.linalg.norm(rays, axis=1), 1e-6)
    rays /= distances[:, None]
    first = np.searchsorted(marks.obs_landmark, np.arange(len(marks.points_map)))
    cosines = np.einsum("ij,ij->i", rays, rays[first][marks.obs_landmark])
    angles = np.zeros(len(marks.points_map))
    np.maximum.at(angles, marks.obs_landmark, np.arccos(np.clip(cosines, -1.0, 1.0)))
    across = np.where(np.isfinite(marks.obs_pixels[:, 2]), state.rig.camera.baseline_m / distances, 0.0)
    np.maximum.at(angles, marks.obs_landmark, across)
    return angles


def _duplicates(
    marks: Landmarks, keyframes: list[Keyframe], sigmas_m: Array, settings: CullSettings
) -> NDArray[np.bool_]:
    """Return (N,) landmarks at the position of a better observed similar one, never seen beside it."""
    near = cKDTree(marks.points_map).query_pairs(settings.duplicate_m, output_type="ndarray")
    if not len(near):
        return np.zeros(len(marks.points_map), bool)
    starts = np.searchsorted(marks.obs_landmark, np.arange(len(marks.points_map) + 1))
    first = replace(marks, obs_keyframe=marks.obs_keyframe[starts[:-1]], obs_feature=marks.obs_feature[starts[:-1]])
    near = near[np.lexsort((near[:, 1], near[:, 0]))].astype(np.int64)
    descriptors = packed(first.of_features([k.features.descriptors for k in keyframes]))
    landmarks = marks.points_map, sigmas_m, starts, marks.obs_keyframe, descriptors
    return core.duplicate_landmarks(near, *landmarks, settings.duplicate_distance)


def redundant(
    marks: Landmarks, octaves: NDArray[np.int64], lasting: NDArray[np.bool_], count: int, settings: CullSettings
) -> NDArray[np.bool_]:
    """Return (count,) keyframes whose landmarks are to a `redundant_share` seen by three others at the same or a finer scale.

    Removed one by one, those with the fewest landmarks first, so that mutually redundant ones are not all removed.
    Source: Mur-Artal and Tardos 2015 (ORB-SLAM).
    """
    usable = np.flatnonzero(lasting[marks.obs_landmark])
    own = marks.obs_keyframe[usable]
    seen = np.bincount(own, minlength=count)
    starts = np.searchsorted(marks.obs_landmark, np.arange(len(marks.points_map) + 1))
    order = np.array(sorted(range(1, count - 1), key=lambda k: (seen[k], k)), np.int64)
    rows, row_starts = usable[np.argsort(own, kind="stable")], np.concatenate([[0], np.cumsum(seen)])
    observed = marks.obs_landmark, marks.obs_keyframe, octaves, starts
    return core.redundant_keyframes(
        order, rows, row_starts, *observed, settings.redundant_observers, settings.redundant_share
    )
