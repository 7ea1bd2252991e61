"""Division of a survey into the tiles for robots. Pure."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array
from fleetmap.mapformat.tile import Tile
from mapserver.survey.survey_map import SurveyMap, history_of, viewing_cones

TILE_SIZE_M = 16.0
MAX_PLACE_LANDMARKS = 300
_Ids = NDArray[np.uint32]


def tiles_from_survey(survey: SurveyMap, chosen: NDArray[np.bool_] | None = None) -> list[Tile]:
    """Return the survey divided into squares of TILE_SIZE_M, ordered by x, then y.

    Landmarks lie in the tile of their position, places (keyframes offered as such, under their ids) in that
    of their camera's centre. A place lists at most MAX_PLACE_LANDMARKS of the landmarks seen there, those with most
    observations in the survey. Landmarks without observations are left out: their viewing directions are unknown.
    chosen (N,): the landmarks for robots, all if None.
    Raises SurveyError for a survey with values that are not finite.
    """
    map_from_cam = survey.map_from_body @ survey.body_from_cam
    bad_points = int((~np.isfinite(survey.points_map).all(axis=1)).sum())
    bad_places = int((~np.isfinite(map_from_cam).all(axis=(1, 2))).sum())
    if bad_points or bad_places:
        raise SurveyError(
            f"{bad_points} landmarks and {bad_places} keyframes of the survey are not finite; its adjustment failed"
        )
    cones = viewing_cones(survey, map_from_cam)
    counts = np.bincount(survey.obs_landmark, minlength=len(survey.landmark_ids))
    chosen = np.ones(len(survey.landmark_ids), bool) if chosen is None else chosen
    kept = np.flatnonzero((counts > 0) & chosen)
    kept = kept[np.argsort(survey.landmark_ids[kept], kind="stable")]
    landmark_cells, place_cells = cells_of(survey.points_map[kept]), cells_of(map_from_cam[:, :3, 3])
    references = _place_landmarks(survey, counts, chosen)
    history = history_of(survey)
    tiles = []
    for cell in sorted({(int(x), int(y)) for x, y in np.concatenate([landmark_cells, place_cells[history.is_place]])}):
        rows = kept[(landmark_cells == cell).all(axis=1)]
        places = np.flatnonzero((place_cells == cell).all(axis=1) & history.is_place)
        places = places[np.argsort(history.keyframe_ids[places], kind="stable")]
        tiles.append(
            Tile(
                tile_x=cell[0],
                tile_y=cell[1],
                size_m=TILE_SIZE_M,
                landmark_ids=survey.landmark_ids[rows],
                points_map=survey.points_map[rows],
                descriptors=survey.descriptors[rows],
                view_directions_map=cones.directions_map[rows],
                view_half_angle_rad=cones.half_angles_rad[rows],
                max_distance_m=cones.max_distances_m[rows],
                sigma_m=survey.point_sigma_m[rows].astype(np.float32),
                place_ids=history.keyframe_ids[places],
                map_from_cam=map_from_cam[places],
                place_landmark_ids=tuple(references[place] for place in places),
            )
        )
    return tiles


def cells_of(points_map: Array) -> NDArray[np.int64]:
    """Return (N, 2) x and y of the tiles in which points (N, 2 or 3) lie."""
    return np.asarray(np.floor(points_map[:, :2] / TILE_SIZE_M), np.int64)


def _place_landmarks(survey: SurveyMap, counts: NDArray[np.intp], chosen: NDArray[np.bool_]) -> list[_Ids]:
    """Return for each keyframe the sorted ids of the best observed chosen landmarks seen in it."""
    ids = survey.landmark_ids
    order = np.lexsort((ids[survey.obs_landmark], -counts[survey.obs_landmark], survey.obs_keyframe))
    order = order[chosen[survey.obs_landmark[order]]]
    bounds = np.searchsorted(survey.obs_keyframe[order], np.arange(len(survey.map_from_body) + 1))
    lists = []
    for start, end in pairwise(bounds):
        seen = ids[survey.obs_landmark[order[start:end]]]
        _, first = np.unique(seen, return_index=True)
        lists.append(np.unique(seen[np.sort(first)[:MAX_PLACE_LANDMARKS]]))
    return lists
