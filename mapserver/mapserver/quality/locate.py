"""One look localised in tiles near a rough prior: matched by descriptor, verified by one camera, completed by projection."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching import match_by_projection, match_mutual
from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.geometry import Array, se3_inverse
from fleetmap.pnp.pnp import PnpResult, ransac_pnp, refine_pnp
from mapserver.quality.probes import Look
from mapserver.quality.tile_map import TileMap
from mapserver.survey.settings import SurveySettings

PRIOR_RADIUS_M = 3.0
_RANSAC_PX = 5.0
_COLUMNS, _ROWS = 8, 6


@dataclass(frozen=True, slots=True)
class Fix:
    """map_from_cam (4, 4) of a look, how many landmarks agree on it, and their median distance from where they should be."""

    map_from_cam: Array
    inliers: int
    residual_px: float


def locate(tile_map: TileMap, look: Look, prior_map_from_cam: Array, settings: SurveySettings) -> Fix | None:
    """The fix within PRIOR_RADIUS_M of the prior, None where too little agrees.

    Only the prior's neighbourhood is searched, so how exact it is does not matter. `settings.sessions` says how many inliers in
    how many cells of the picture a fix needs, as for a survey that is joined to a map.
    """
    first = _first(tile_map, look, prior_map_from_cam, settings)
    if first is None:
        return None
    rough = _again(tile_map, look, first.cam_from_source, settings.sessions.search_px, settings)
    if rough is None:
        return None
    found = _again(tile_map, look, rough.resection.cam_from_source, settings.sessions.guided_px, settings)
    if found is None:
        return None
    resection, measured = found.resection, found.measured
    map_from_cam = se3_inverse(resection.cam_from_source)
    off_m = np.linalg.norm(map_from_cam[:3, 3] - prior_map_from_cam[:3, 3])
    count = int(resection.inliers.sum())
    enough = (
        count >= settings.sessions.min_inliers
        and _cells(look, measured[resection.inliers]) >= settings.sessions.min_cells
    )
    if off_m > PRIOR_RADIUS_M or not enough:
        return None
    return Fix(map_from_cam, count, found.residual_px)


@dataclass(frozen=True, slots=True)
class _Match:
    resection: PnpResult
    measured: Array
    residual_px: float


def _first(tile_map: TileMap, look: Look, prior: Array, settings: SurveySettings) -> PnpResult | None:
    rows = tile_map.neighbourhood(prior, PRIOR_RADIUS_M)
    pairs = match_mutual(
        tile_map.descriptors[rows], look.descriptors, settings.pairs.max_distance, settings.pairs.ratio
    )
    least = settings.sessions.min_inliers // 2
    points_map, measured = tile_map.points_map[rows[pairs[:, 0]]], look.pixels[pairs[:, 1]]
    sigmas_px = np.full((len(pairs), 2), settings.pairs.match_sigma_px)
    return ransac_pnp(
        look.camera, points_map, measured, sigmas_px, threshold_px=_RANSAC_PX, min_inliers=least, seed=settings.seed
    )


def _again(
    tile_map: TileMap, look: Look, cam_from_map: Array, radius_px: float, settings: SurveySettings
) -> _Match | None:
    rows, predicted, octaves = tile_map.visible(se3_inverse(cam_from_map), look.camera)
    span = np.column_stack([np.floor(octaves) - 2, np.ceil(octaves) + 2]).astype(np.int64)
    found, _ = match_by_projection(
        predicted[:, :2], np.full(len(rows), radius_px), tile_map.descriptors[rows], span, look.pixels[:, :2], look.octaves,
        look.descriptors, settings.pairs.guided_distance, 0.95,
    )  # fmt: skip
    hit = np.flatnonzero(found >= 0)
    if len(hit) < settings.sessions.min_inliers:
        return None
    measured = look.pixels[found[hit]]
    points_map = tile_map.points_map[rows[hit]]
    scale = SCALE_FACTOR ** np.minimum(look.octaves[found[hit]], 4).astype(np.float64)
    sigmas_px = settings.pairs.match_sigma_px * np.column_stack([scale, np.maximum(scale, 1.0)])
    solved = refine_pnp(look.camera, points_map, measured, sigmas_px, cam_from_map)
    if solved is None or not solved.inliers.any():
        return None
    seen = points_map[solved.inliers] @ solved.cam_from_source[:3, :3].T + solved.cam_from_source[:3, 3]
    off_px = np.linalg.norm(look.camera.pixel_from_point(seen)[:, :2] - measured[solved.inliers, :2], axis=1)
    return _Match(solved, measured, float(np.median(off_px)))


def _cells(look: Look, pixels: NDArray[np.float64]) -> int:
    """How many of 8 x 6 cells of the picture hold one of the pixels."""
    column = np.clip(pixels[:, 0] / look.camera.width_px * _COLUMNS, 0, _COLUMNS - 1).astype(int)
    row = np.clip(pixels[:, 1] / look.camera.height_px * _ROWS, 0, _ROWS - 1).astype(int)
    return len(np.unique(column * _ROWS + row))
