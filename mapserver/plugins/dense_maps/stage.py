"""The stage of a build that makes them: grid, surfels and pictures of the version before go on with the build's recordings."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from fleetmap.errors import StateError
from fleetmap.geometry import AnyArray, Mask
from fleetmap.version_grid import CELL_M, TILE_CELLS, TILE_SIZE_M, Tiles, encode_grid, grid_report, known_grid
from mapserver.drafting.area_corrections import AreaCorrections
from mapserver.drafting.extras import ChosenDraft, Extra
from mapserver.plugins.dense_maps import surfel_map
from mapserver.plugins.dense_maps.surfel_map import SurfelReport, Surfels, SurfelTile, SurfelTiles, encode_tile
from mapserver.plugins.dense_maps.survey_grid import GridGrower, Grower, grow
from mapserver.plugins.dense_maps.survey_pictures import kept_pictures
from mapserver.plugins.dense_maps.survey_surfels import SurfelGrower
from mapserver.store.survey_pictures import PICTURES_KEY, SurveyPicture

_Place = tuple[int, int]
_CENTRES_M = (np.stack(np.meshgrid(*[np.arange(TILE_CELLS)] * 2), axis=-1).reshape(-1, 2) + 0.5) * CELL_M  # row by row


def make_dense_maps(draft: ChosenDraft) -> dict[str, Extra]:
    """Return what [survey] asks for of grid, surfels and pictures; None for a report without one."""
    settings, parent, maps = draft.settings, draft.parent, draft.maps
    old_grid = {} if parent is None else known_grid(parent, maps.blob)
    grid_grower = GridGrower(grid_before(draft.corrections, old_grid))
    growers: dict[str, Grower] = {"grid": grid_grower} if settings.occupancy_grid else {}
    if settings.surfel_map:
        known = SurfelTiles() if parent is None else surfel_map.known_surfels(parent, maps.blob)
        growers["surfels"] = surfel_grower = SurfelGrower(surfels_without(known, draft.corrections.is_due))
    without = grow(growers, draft.sessions, settings.stereo)
    grid = encode_grid(corrected_grid(draft.corrections, grid_grower.tiles, old_grid))
    said = grid_report(grid, without.get("grid", {})) if grid or without.get("grid") else None
    found = {"grid": Extra(said, "grid", grid), "surfels": Extra(None, "surfel", ())}
    if settings.surfel_map:
        grown = corrected_surfels(draft.corrections, surfel_grower.surfels, known)
        surfels = grown.blobs()
        found["surfels"] = Extra(SurfelReport.of(surfels, without["surfels"], surfels=len(grown)), "surfel", surfels)
    return found | {PICTURES_KEY: _pictures(draft)}


def _pictures(draft: ChosenDraft) -> Extra:
    parent, maps = draft.parent, draft.maps
    if not draft.settings.survey_pictures:
        return Extra(None, "surfel", ())
    before: tuple[SurveyPicture, ...] = ()
    if parent is not None and PICTURES_KEY in parent.report:
        with suppress(StateError):  # all of them were removed after their period
            before = maps.survey_pictures(parent.site, parent.version)
    blobs, said = kept_pictures(draft.sessions, pictures_before(draft.corrections, before), maps.blob, maps.now_ns())
    return Extra(said, "surfel", blobs)


def grid_before(areas: AreaCorrections, before: Tiles) -> Tiles:
    """Return the grid on which a build goes on."""
    return {place: np.where(_cells(place, areas.is_due), np.uint8(0), cells) for place, cells in before.items()}


def corrected_grid(areas: AreaCorrections, grown: Tiles, before: Tiles) -> Tiles:
    """Return a grown grid with cells unknown where nothing is used, and as before where it is frozen."""
    found, none = {}, np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8)
    for place, cells in grown.items():
        kept = np.where(_cells(place, areas.frozen), before.get(place, none), cells)
        found[place] = np.where(_cells(place, areas.is_unused), np.uint8(0), kept)
    return found


def corrected_surfels(areas: AreaCorrections, grown: SurfelTiles, before: SurfelTiles) -> SurfelTiles:
    """Return grown surfels without those where nothing is used, and with those of before where it is frozen."""
    left = surfels_without(grown, lambda points: areas.frozen(points) | areas.is_unused(points))
    tiles = dict(left.tiles)
    for place in before.tiles if areas.freezes else ():
        old = before.surfels(place)
        kept = old[areas.frozen(old.points_map) & ~areas.is_unused(old.points_map)]
        if len(kept):
            tiles[place] = encode_tile(place, Surfels.joined([left.surfels(place), kept]))
    return replace(left, tiles=tiles)


def pictures_before(areas: AreaCorrections, before: Iterable[SurveyPicture]) -> list[SurveyPicture]:
    """Return the pictures of the version before that were not taken where it is due to be forgotten."""
    return [one for one in before if not areas.is_due(np.array([one.place_map_m]))[0]]


def _cells(place: _Place, chosen: Callable[[AnyArray], Mask]) -> Mask:
    """Return (N, N, 1) which cells of a grid tile are chosen by their centres."""
    return chosen(np.array(place) * TILE_SIZE_M + _CENTRES_M).reshape(TILE_CELLS, TILE_CELLS, 1)


def surfels_without(surfels: SurfelTiles, gone: Callable[[AnyArray], Mask]) -> SurfelTiles:
    """Return the surfels but those at places that are gone."""
    tiles: dict[_Place, SurfelTile] = dict(surfels.tiles)
    for place in surfels.tiles:
        old = surfels.surfels(place)
        removed = gone(old.points_map)
        if removed.all():
            del tiles[place]
        elif removed.any():
            tiles[place] = encode_tile(place, old[~removed])
    return replace(surfels, tiles=tiles)
