"""Division of a survey into the tiles for robots, with the landmarks best for localization, within a budget per metre of path. Pure.

A survey has many more landmarks than a robot needs. Every keyframe stands for what robots will see there: its picture is divided into bins,
and a landmark's gain in a bin shrinks with the number already there, so that they are spread over the picture and over near and far. Every
view gets the landmarks for a certain fix before any gets more: at the end of a drive few keyframes see landmarks that others do not.
Landmarks seen often, from many directions, and with small uncertainty count more, because they will be seen again.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.errors import SurveyError
from fleetmap.features.matching import packed
from fleetmap.geometry import Array, Indices, Mask, se3_inverse
from fleetmap.mapformat.tile import Tile
from mapserver.survey.merge.landmark_persistence import PRIOR_COUNT
from mapserver.survey.settings import BudgetSettings
from mapserver.survey.survey_map import SurveyMap, history_of, viewing_cones

TILE_SIZE_M = 16.0
MAX_PLACE_LANDMARKS = 300
_Ids = NDArray[np.uint32]


def tiles_from_survey(survey: SurveyMap, chosen: Mask | None = None) -> list[Tile]:
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


def cells_of(points_map: Array) -> Indices:
    """Return (N, 2) x and y of the tiles in which points (N, 2 or 3) lie."""
    return np.asarray(np.floor(points_map[:, :2] / TILE_SIZE_M), np.int64)


def _place_landmarks(survey: SurveyMap, counts: NDArray[np.intp], chosen: Mask) -> list[_Ids]:
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


# An object differs from its identical copy by about 30 bits, two objects by 128; copies have the same height above the ground.
_ALIKE_BITS, _HEIGHT_M = 60, 0.15
_OWN_M = 2.0  # within it the same object may have been mapped twice
_REACH = 6  # neighbours compared among those that agree in two bytes
_MOST_COMPARED = 10_000  # a landmark without a copy among these counts as unique


def distinctive_landmarks(points_map: Array, descriptors: NDArray[np.uint8]) -> Mask:
    """Return (N,) which landmarks (N, 3) with descriptors (N, 32) have no copy: no similar one at the same height farther off.

    Copies mostly agree in two bytes, and are neighbours after sorting by those; the few without are then compared
    with all at the same height, in a large survey with an evenly chosen part of them.
    """
    by_height = np.argsort(points_map[:, 2], kind="stable")  # used by the second search
    points, words = np.ascontiguousarray(points_map[by_height]), packed(descriptors[by_height])
    distinct = np.empty(len(points), bool)
    distinct[by_height] = ~core.twins(words, points, _REACH, _MOST_COMPARED, _ALIKE_BITS, _HEIGHT_M, _OWN_M)
    return distinct


_COLUMNS, _ROWS, _DEPTHS = 4, 3, 2
_NO_LIMIT = 1 << 40
_LONGEST_STEP_M = 10.0  # between keyframes; a longer step is a break, not a path
_CLOSE_BASELINES = 40.0
_WIDE_RAD = np.radians(20.0)
_SAME_WAY_M, _SAME_WAY_AFTER_M, _SAME_WAY_COSINE = 1.0, 5.0, 0.5


class Sighting(NamedTuple):
    """A view besides the keyframes: map_from_cam (4, 4), its landmarks (P,), rows of the survey, and their pixels (P, 3)."""

    map_from_cam: Array
    landmarks: Indices
    pixels: Array


def choose_landmarks(
    survey: SurveyMap, settings: BudgetSettings, published: _Ids | None = None, sightings: Sequence[Sighting] = ()
) -> Mask:
    """Return (N,) which landmarks of the survey robots get.

    At most settings.landmarks_per_m for every metre of `covered_path_m` (min_landmarks are always allowed: a short survey
    covers a whole room), and tile_landmarks in a tile. First come those that give view_landmarks to each of `sightings`. Then those
    with ids in `published` come before all others, so that robots do not fetch another equally good choice every night. Among those
    and among the others, first come those that give every keyframe view_distinctive_landmarks unlike any other in the survey,
    then those that give it view_landmarks, or as many as it sees. Landmarks without observations are not chosen.
    """
    limit = max(settings.min_landmarks, int(settings.landmarks_per_m * covered_path_m(survey)))
    starts, bins, weights = _views(survey, sightings)
    squares, cells = np.unique(cells_of(survey.points_map), axis=0, return_inverse=True)
    cells, room = cells.reshape(-1).astype(np.int64), np.full(len(squares), settings.tile_landmarks, np.int64)
    counts = np.zeros(int(bins.max(initial=-1)) + 1, np.int64)
    chosen = np.zeros(len(survey.landmark_ids), bool)
    seen = np.diff(starts) > 0
    first = seen & np.isin(survey.landmark_ids, [] if published is None else published)
    distinct = distinctive_landmarks(survey.points_map, survey.descriptors)
    per_view = _ROWS * _COLUMNS * _DEPTHS
    keyframes = len(survey.map_from_body)
    taken = np.zeros(keyframes + len(sightings), np.int64)
    matched = np.zeros(len(chosen), bool)
    for each in sightings:
        matched[each.landmarks] = True
    of_sightings = np.where(np.arange(len(taken)) < keyframes, 0, settings.view_landmarks)
    passes: list[tuple[Mask, Indices | int]] = [(matched, of_sightings)]
    for mask in (first, seen & ~first):
        passes += [(mask & distinct, settings.view_distinctive_landmarks), (mask, settings.view_landmarks)]
        passes.append((mask, _NO_LIMIT))
    for mask, quota in passes:
        left, needs = np.flatnonzero(mask & ~chosen), quota - taken
        if len(left) and limit > 0:
            limit -= core.choose_landmarks(
                left, starts, bins, weights, cells, room, limit, counts, chosen, needs, per_view
            )
            taken = quota - needs
    return chosen


def covered_path_m(survey: SurveyMap) -> float:
    """Return the length in metres from keyframe to keyframe, without breaks and repeated paths in the same direction.

    With the latter every night would increase a site's budget although its aisles are no longer than before.
    """
    map_from_cam = survey.map_from_body @ survey.body_from_cam
    places, axes = map_from_cam[:, :3, 3], map_from_cam[:, :3, 2]
    steps_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    way_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    total_m = 0.0
    for k in np.flatnonzero(steps_m < _LONGEST_STEP_M) + 1:
        before = int(np.searchsorted(way_m, way_m[k] - _SAME_WAY_AFTER_M))
        near = np.linalg.norm(places[:before] - places[k], axis=1) < _SAME_WAY_M
        if not (near & (axes[:before] @ axes[k] > _SAME_WAY_COSINE)).any():
            total_m += float(steps_m[k - 1])
    return total_m


def _views(survey: SurveyMap, sightings: Sequence[Sighting]) -> tuple[Indices, Indices, Array]:
    """Return the start of each landmark's bins (N + 1,), the bins (M,) of all observations by landmark, and weights (N,)."""
    count, camera = len(survey.landmark_ids), survey.camera
    map_from_keyframe = survey.map_from_body @ survey.body_from_cam
    map_from_cam = np.concatenate([map_from_keyframe, *(each.map_from_cam[None] for each in sightings)])
    landmark = np.concatenate([survey.obs_landmark, *(each.landmarks for each in sightings)])
    pixels = np.concatenate([survey.obs_pixels, *(each.pixels for each in sightings)])
    view = np.concatenate([
        survey.obs_keyframe.astype(np.int64),
        np.repeat(np.arange(len(map_from_keyframe), len(map_from_cam)), [len(each.landmarks) for each in sightings]),
    ])  # fmt: skip
    points_cam = np.einsum(
        "mij,mj->mi", se3_inverse(map_from_cam)[view, :3, :3], survey.points_map[landmark] - map_from_cam[view, :3, 3]
    )
    column = np.clip(pixels[:, 0] / camera.width_px * _COLUMNS, 0, _COLUMNS - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] / camera.height_px * _ROWS, 0, _ROWS - 1).astype(np.int64)
    is_far = points_cam[:, 2] > _CLOSE_BASELINES * camera.baseline_m
    bins = ((view * _ROWS + row) * _COLUMNS + column) * _DEPTHS + is_far
    order = np.argsort(landmark, kind="stable")
    starts = np.searchsorted(landmark[order], np.arange(count + 1))
    return starts.astype(np.int64), bins[order], _weights(survey, map_from_keyframe)


def _weights(survey: SurveyMap, map_from_cam: Array) -> Array:
    """Return (N,) weights: probability that a landmark is seen again, times its information.

    The share of looks in which later surveys saw it, with some looks at the rate of all by Laplace's rule for n - 1 repeated
    observations; up to twice that for directions 20 degrees apart; less the more pixels its own uncertainty spans.
    """
    landmark, count = survey.obs_landmark, len(survey.landmark_ids)
    seen = np.bincount(landmark, minlength=count)
    offsets = map_from_cam[survey.obs_keyframe, :3, 3] - survey.points_map[landmark]
    distances_m = np.maximum(np.linalg.norm(offsets, axis=1), 1e-6)
    rays = offsets / distances_m[:, None]
    mean = np.stack([np.bincount(landmark, rays[:, axis], count) for axis in range(3)], axis=1)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    spread = np.zeros(count)
    np.maximum.at(spread, landmark, np.arccos(np.clip(np.einsum("ij,ij->i", rays, mean[landmark]), -1, 1)))
    nearest_m = np.full(count, np.inf)
    np.minimum.at(nearest_m, landmark, distances_m)
    sigma_px = survey.camera.focal_px * survey.point_sigma_m / nearest_m
    history = history_of(survey)
    rate = history.landmark_seen.sum() / max(history.landmark_expected.sum(), 1) or 1.0
    again = history.landmark_seen + PRIOR_COUNT * rate * seen / (seen + 1.0)
    found = again / (history.landmark_expected + PRIOR_COUNT)
    return np.asarray(found * (1.0 + np.minimum(2 * spread / _WIDE_RAD, 1.0)) / (1.0 + sigma_px**2))
