"""Directions and distances from which the landmarks of a survey were seen. Pure."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.geometry import Array
from fleetmap.relocalization.landmark_visibility import ViewingCones
from mapserver.survey.survey_map import SurveyMap


def viewing_cones(survey: SurveyMap, map_from_cam: Array) -> ViewingCones:
    """Return the viewing cones of a survey's landmarks (N), with its keyframes' cameras at map_from_cam (K, 4, 4).

    Directions: mean of those to the cameras; half angles: largest angle to it; distances: median over observations of
    distance * scale ** octave. Half angle and distance are 0 for a landmark without observations.
    Source: Mur-Artal et al. 2015 (ORB-SLAM), section III.C.
    """
    landmark, count = survey.obs_landmark, len(survey.landmark_ids)
    offsets_map = map_from_cam[survey.obs_keyframe, :3, 3] - survey.points_map[landmark]
    distances_m = np.linalg.norm(offsets_map, axis=1)
    rays_map = offsets_map / np.maximum(distances_m, 1e-9)[:, None]
    counts = np.bincount(landmark, minlength=count)
    directions_map = _mean_directions(landmark, rays_map, counts)
    cosines = np.einsum("ij,ij->i", rays_map, directions_map[landmark])
    half_angles_rad = np.zeros(count)
    np.maximum.at(half_angles_rad, landmark, np.arccos(np.clip(cosines, -1.0, 1.0)))
    max_distances_m = _medians(landmark, distances_m * SCALE_FACTOR**survey.obs_octave, counts)
    rounded = (values.astype(np.float32) for values in (directions_map, half_angles_rad, max_distances_m))
    return ViewingCones(survey.points_map, *rounded)


def _mean_directions(landmark: NDArray[np.int32], rays_map: Array, counts: NDArray[np.intp]) -> Array:
    sums = np.stack([np.bincount(landmark, rays_map[:, axis], len(counts)) for axis in range(3)], axis=1)
    # Seen from opposite sides the mean is zero; any direction will do, the half angle then includes all others.
    vague = np.linalg.norm(sums, axis=1) < 1e-6 * np.maximum(counts, 1)
    first_seen = np.unique(landmark, return_index=True)
    fallback = np.tile([0.0, 0.0, 1.0], (len(counts), 1))
    fallback[first_seen[0]] = rays_map[first_seen[1]]
    sums[vague] = fallback[vague]
    return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True))


def _medians(groups: NDArray[np.int32], values: Array, counts: NDArray[np.intp]) -> Array:
    """Return (N,) median (the upper of two middle ones) of the values of each group, 0 for empty ones."""
    ordered = values[np.lexsort((values, groups))]
    starts = np.cumsum(counts) - counts
    medians = np.zeros(len(counts))
    filled = counts > 0
    medians[filled] = ordered[(starts + counts // 2)[filled]]
    return medians
