"""What a finished survey does not hand on: duplicates, landmarks that are badly known, keyframes that others make superfluous."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fleetmap.geometry import Array
from mapserver.survey.adjust import SurveyState
from mapserver.survey.keyframes import Keyframe
from mapserver.survey.settings import CullSettings
from mapserver.survey.tracks import Landmarks


@dataclass(frozen=True, slots=True)
class Culled:
    """How many were taken out: landmarks_merged into another, landmarks_weak, keyframes that others repeat."""

    landmarks_merged: int = 0
    landmarks_weak: int = 0
    keyframes_redundant: int = 0


def cull(
    state: SurveyState, keyframes: list[Keyframe], sigmas_m: Array, settings: CullSettings
) -> tuple[Landmarks, NDArray[np.bool_], Culled]:
    """The landmarks that are handed on, which keyframes (K,) are, and what was left out; `state` stays as it is.

    sigmas_m (N,) of the landmarks.
    """
    marks = state.landmarks
    octaves = np.array(
        [keyframes[k].features.octaves[f] for k, f in zip(marks.obs_keyframe, marks.obs_feature, strict=True)], np.int64
    )
    double = _duplicates(marks, keyframes, sigmas_m, settings)
    weak = ~double & (parallax_rad(state) < np.radians(settings.min_parallax_deg))
    lasting = ~(double | weak)
    superfluous = redundant(marks, octaves, lasting, len(keyframes), settings)
    keep = lasting[marks.obs_landmark] & ~superfluous[marks.obs_keyframe]
    left = marks.keep_observations(keep, 1)
    return left, ~superfluous, Culled(int(double.sum()), int(weak.sum()), int(superfluous.sum()))


def parallax_rad(state: SurveyState) -> Array:
    """(N,) the angle under which each landmark's observations see it: largest between any and the first, or across the baseline."""
    marks = state.landmarks
    centres = (state.map_from_body @ state.body_from_cam)[marks.obs_keyframe, :3, 3]
    rays = centres - marks.points_map[marks.obs_landmark]
    distances = np.maximum(np.linalg.norm(rays, axis=1), 1e-6)
    rays /= distances[:, None]
    first = np.searchsorted(marks.obs_landmark, np.arange(len(marks.points_map)))
    cosines = np.einsum("ij,ij->i", rays, rays[first][marks.obs_landmark])
    angles = np.zeros(len(marks.points_map))
    np.maximum.at(angles, marks.obs_landmark, np.arccos(np.clip(cosines, -1.0, 1.0)))
    across = np.where(np.isfinite(marks.obs_pixels[:, 2]), state.camera.baseline_m / distances, 0.0)
    np.maximum.at(angles, marks.obs_landmark, across)
    return angles


def _duplicates(
    marks: Landmarks, keyframes: list[Keyframe], sigmas_m: Array, settings: CullSettings
) -> NDArray[np.bool_]:
    """(N,) landmarks that stand where a better observed one stands, look like it and were never seen beside it."""
    double = np.zeros(len(marks.points_map), bool)
    near = cKDTree(marks.points_map).query_pairs(settings.duplicate_m, output_type="ndarray")
    if not len(near):
        return double
    starts = np.searchsorted(marks.obs_landmark, np.arange(len(marks.points_map) + 1))
    counts = np.diff(starts)
    order = np.lexsort((near[:, 1], near[:, 0]))
    for a, b in near[order]:
        if double[a] or double[b]:
            continue
        apart_m = float(np.linalg.norm(marks.points_map[a] - marks.points_map[b]))
        if apart_m > 3.0 * float(np.hypot(sigmas_m[a], sigmas_m[b])):
            continue
        of_a, of_b = slice(starts[a], starts[a + 1]), slice(starts[b], starts[b + 1])
        if np.intersect1d(marks.obs_keyframe[of_a], marks.obs_keyframe[of_b]).size:
            continue
        first, second = (
            keyframes[marks.obs_keyframe[s.start]].features.descriptors[marks.obs_feature[s.start]]
            for s in (of_a, of_b)
        )
        if int(np.bitwise_count(first ^ second).sum()) <= settings.duplicate_distance:
            double[b if counts[a] >= counts[b] else a] = True
    return double


def redundant(
    marks: Landmarks, octaves: NDArray[np.int64], lasting: NDArray[np.bool_], count: int, settings: CullSettings
) -> NDArray[np.bool_]:
    """(count,) keyframes of whose landmarks `redundant_share` are seen by three others at the same or a finer scale.

    Taken out one by one, those with the fewest landmarks first, so that the ones that repeat each other do not all go.
    Source: Mur-Artal and Tardos 2015 (ORB-SLAM).
    """
    gone = np.zeros(count, bool)
    usable = lasting[marks.obs_landmark]
    by_keyframe = [np.flatnonzero((marks.obs_keyframe == k) & usable) for k in range(count)]
    starts = np.searchsorted(marks.obs_landmark, np.arange(len(marks.points_map) + 1))
    for k in sorted(range(1, count - 1), key=lambda k: (len(by_keyframe[k]), k)):
        own = by_keyframe[k]
        if not len(own):
            gone[k] = True
            continue
        repeated = 0
        for row in own:
            others = slice(starts[marks.obs_landmark[row]], starts[marks.obs_landmark[row] + 1])
            finer = (octaves[others] <= octaves[row] + 1) & ~gone[marks.obs_keyframe[others]]
            repeated += int(finer.sum()) - 1 >= settings.redundant_observers
        gone[k] = repeated >= settings.redundant_share * len(own)
    return gone
