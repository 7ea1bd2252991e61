"""Corrections by areas, at the grid, the surfels and the pictures."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.mapformat.names import sha256_hex
from mapserver.drafting.area_corrections import AreaCorrections
from mapserver.floor_plan.areas import Area, Correction, CorrectionKind
from mapserver.plugins.dense_maps import stage
from mapserver.plugins.dense_maps.surfel_map import Surfels, SurfelTiles, encode_tile
from mapserver.store.survey_pictures import SurveyPicture

FORGET, NEVER_USE, FREEZE = CorrectionKind


def area(kind: CorrectionKind, low: tuple[float, float], high: tuple[float, float]) -> Area:
    ring = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    return Area(f"{kind} {low}", ((ring,),), correction=Correction(kind, "moved", 1))


def test_cells_are_unknown_kept_or_grown() -> None:
    grown, before = {(0, 0): np.full((320, 320, 4), 9, np.uint8)}, {(0, 0): np.full((320, 320, 4), 3, np.uint8)}
    corrections = AreaCorrections([area(NEVER_USE, (0, 8), (4, 16)), area(FREEZE, (8, 0), (16, 4))])
    cells = stage.corrected_grid(corrections, grown, before)[0, 0]
    assert (cells[160:, :80] == 0).all(), "rows are y"
    assert (cells[:80, 160:] == 3).all()
    assert (cells == 9).sum() == cells.size - 2 * 160 * 80 * 4
    due = stage.grid_before(AreaCorrections((), [area(FORGET, (0, 8), (4, 16))]), before)[0, 0]
    assert ((due == 0).sum(), (due == 3).sum()) == (160 * 80 * 4, due.size - 160 * 80 * 4)


def surfels(places: Array, grey: int) -> Surfels:
    count = len(places)
    points = np.column_stack([places, np.ones(count)]).astype(np.float32)
    normals = np.tile(np.float32([1, 0, 0]), (count, 1))
    return Surfels(points, normals, np.zeros(count, np.uint8), np.full(count, grey, np.uint8))


def test_surfels_and_pictures() -> None:
    places = np.stack(np.meshgrid(np.arange(16) + 0.5, np.arange(16) + 0.5), axis=-1).reshape(-1, 2)
    old, new = (SurfelTiles({(0, 0): encode_tile((0, 0), surfels(places, grey))}) for grey in (3, 9))
    corrections = AreaCorrections([area(NEVER_USE, (0, 8), (4, 16)), area(FREEZE, (8, 0), (16, 4))])
    found = stage.corrected_surfels(corrections, new, old).surfels((0, 0))
    places = map(tuple, np.floor(found.points_map[:, :2]).tolist())
    at = dict(zip(places, found.greys.tolist(), strict=True))
    assert len(at) == len(found) == 256 - 32
    assert {grey for (x, y), grey in at.items() if x >= 8 and y < 4} == {3}
    assert {grey for (x, y), grey in at.items() if not (x >= 8 and y < 4)} == {9}
    everywhere = AreaCorrections((), [area(FORGET, (-1, -1), (17, 17))])
    assert stage.surfels_without(old, everywhere.is_due).tiles == {}
    picture = SurveyPicture(
        place_map_m=(2.0, 9.0, 1.0), looks_map=(1.0, 0.0, 0.0), stamp_ns=1, kept_ns=1, recording="a", sha256=sha256_hex(b""), bytes=1
    )  # fmt: skip
    assert stage.pictures_before(everywhere, [picture]) == []
    assert stage.pictures_before(corrections, [picture]) == [picture]
