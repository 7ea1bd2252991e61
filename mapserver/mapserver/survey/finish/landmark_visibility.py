"""From where the landmarks of a survey were seen. Pure."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from mapserver.survey.survey_map import SurveyMap

OCTAVE_SCALE = 1.2


class Views:
    """From where each of the N landmarks was seen.

    counts (N,) observations; directions_map (N, 3) unit mean direction towards the cameras; half_angle_rad (N,) the
    largest angle to it; max_distance_m (N,) median over observations of distance * scale ** octave. Zeros where counts
    is 0, except directions.
    """

    def __init__(self, survey: SurveyMap, map_from_cam: Array) -> None:
        landmark, count = survey.obs_landmark, len(survey.landmark_ids)
        offsets_map = map_from_cam[survey.obs_keyframe, :3, 3] - survey.points_map[landmark]
        distances_m = np.linalg.norm(offsets_map, axis=1)
        rays_map = offsets_map / np.maximum(distances_m, 1e-9)[:, None]
        self.counts = np.bincount(landmark, minlength=count)
        self.directions_map = _mean_directions(landmark, rays_map, self.counts)
        cosines = np.einsum("ij,ij->i", rays_map, self.directions_map[landmark])
        self.half_angle_rad = np.zeros(count)
        np.maximum.at(self.half_angle_rad, landmark, np.arccos(np.clip(cosines, -1.0, 1.0)))
        self.max_distance_m = _medians(landmark, distances_m * OCTAVE_SCALE**survey.obs_octave, self.counts)


def _mean_directions(landmark: NDArray[np.int32], rays_map: Array, counts: NDArray[np.intp]) -> Array:
    sums = np.stack([np.bincount(landmark, rays_map[:, axis], len(counts)) for axis in range(3)], axis=1)
    # Seen from opposite sides the mean has no direction; any will do, the half angle then includes all others.
    vague = np.linalg.norm(sums, axis=1) < 1e-6 * np.maximum(counts, 1)
    first_seen = np.unique(landmark, return_index=True)
    fallback = np.tile([0.0, 0.0, 1.0], (len(counts), 1))
    fallback[first_seen[0]] = rays_map[first_seen[1]]
    sums[vague] = fallback[vague]
    return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True))


def _medians(groups: NDArray[np.int32], values: Array, counts: NDArray[np.intp]) -> Array:
    """(N,) median (the upper of two middle ones) of the values of each group, 0 for empty ones."""
    ordered = values[np.lexsort((values, groups))]
    starts = np.cumsum(counts) - counts
    medians = np.zeros(len(counts))
    filled = counts > 0
    medians[filled] = ordered[(starts + counts // 2)[filled]]
    return medians
