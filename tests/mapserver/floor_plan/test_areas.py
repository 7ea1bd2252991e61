"""Named areas: what is read, what is refused, and which one holds a place or a tile."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetmap.mapformat.building import BuildingFrame, Floor, FloorEntry, read_lifts
from mapserver.drafting.area_corrections import AreaCorrections
from mapserver.floor_plan.areas import Areas, MaskKind, read_areas
from mapserver.floor_plan.masks import mask_grid


def box(x0: float, y0: float, x1: float, y1: float) -> list[list[float]]:
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]


def feature(name: object, *rings: Sequence[Sequence[float]], kind: str = "Polygon") -> dict[str, Any]:
    coordinates = list(rings) if kind == "Polygon" else [[ring] for ring in rings]
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": {"name": name}}


def collection(*features: object, frame: str | None = "map") -> bytes:
    said = {} if frame is None else {"frame": frame}
    return json.dumps({"type": "FeatureCollection", "features": list(features), **said}).encode()


def aisles() -> Areas:
    hall = feature("hall", box(0, 0, 64, 32), box(40, 10, 50, 20))
    both = feature("docks", box(-8, 0, -4, 4), box(-8, 20, -4, 24), kind="MultiPolygon")
    found = [feature(f"aisle {n}", box(2, 4 * n, 30, 4 * n + 3)) for n in range(1, 5)]
    return read_areas(collection(hall, both, *found), None)


def test_the_smallest_area_holds_a_place() -> None:
    areas = aisles()
    assert areas.at(10, 5) == "aisle 1"
    assert areas.at(10, 7.5) == areas.at(60, 30) == "hall"
    assert areas.at(-5, 22) == areas.at(-5, 2) == "docks"
    assert areas.at(45, 15) is None  # a hole
    assert areas.at(-5, 12) is areas.at(1e9, 0) is areas.at(float("nan"), 0) is None
    assert Areas().at(0, 0) is None


def test_a_point_is_inside_exactly_where_winding_says_so() -> None:
    rng = np.random.default_rng(3)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 40))
    star = np.c_[np.cos(angles), np.sin(angles)] * rng.uniform(2, 9, (40, 1))
    areas = read_areas(collection(feature("star", [*star.tolist(), star[0].tolist()])), None)
    for x, y in rng.uniform(-10, 10, (300, 2)):
        turned = np.diff(np.unwrap(np.arctan2(*(np.r_[star, star[:1]] - (x, y)).T[::-1]))).sum()
        assert (areas.at(x, y) == "star") is bool(abs(turned) > np.pi)


def test_tiles_are_named_by_the_areas_that_they_lie_in() -> None:
    areas = aisles()
    assert areas.tile_words((0, 0), 16.0) == "hall, aisle 1, aisle 2 and 1 more (tile 0,0)"
    assert areas.tile_words((3, 1), 16.0) == "hall (tile 3,1)"
    assert areas.tile_words((9, 9), 16.0) == "tile 9,9"
    said = areas.name_tiles("2 tiles (tile 3,1: 4 places; tile -9,-9: 2 places)", 16.0)
    assert said == "2 tiles (hall (tile 3,1): 4 places; tile -9,-9: 2 places)"


def test_areas_of_the_building_come_into_the_map() -> None:
    frame = BuildingFrame(x_m=10.0, y_m=-20.0, yaw_rad=np.pi / 2)
    areas = read_areas(collection(feature("gate", box(8, -20, 10, -15)), frame="building"), frame)
    assert areas.at(2.5, 1.0) == "gate"  # five metres up in the building are along x of the map
    assert areas.at(9.0, -18.0) is None
    assert read_areas(json.dumps(areas.geojson("hall")).encode(), None).at(2.5, 1.0) == "gate"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"{", "give a GeoJSON FeatureCollection"),
        (b'{"type": "Feature"}', "FeatureCollection"),
        (b"[" * 100_000, "areas"),
        (collection(), "0 features"),
        (collection(feature("a", box(0, 0, 1, 1)), frame=None), "does not name the frame"),
        (collection(feature("a", box(0, 0, 1, 1)), frame="EPSG:4326"), "frame"),
        (collection(feature("a", box(0, 0, 1, 1)), frame="building"), "run `mapserver align "),
        (collection(feature("a", box(0, 0, 1, 1)), feature("a", box(3, 3, 4, 4))), "'a' occurs twice"),
        (collection(feature("a", box(0, 0, 1, 1)[:-1])), "not closed"),
        (collection(feature("a", box(0, 0, 1, 1)[:2])), "4 or more positions"),
        (collection(feature("a", [[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]])), "crosses itself"),
        (collection(feature("a", [[0, 0], [4, 0], [2, 0], [2, 3], [0, 0]])), "crosses itself"),
        (collection(feature("a", [[0, 0], [0, 0], [4, 0], [0, 4], [0, 0]])), "are the same"),
        (collection(feature("a", [[0, 0], [4, 0], [8, 1e-5], [4, 1e-5], [0, 0]])), "without any area"),
        (collection(feature("a", [[0, 0, 0, 0], [4, 0], [4, 4], [0, 0]])), "positions"),
        (collection(feature("a", [["0", 0], [4, 0], [4, 4], [0, 0]])), "Expected"),
        (collection(feature("a", box(13.4, 52.5, 2e6, 53))), "write metres"),
        (collection(feature("a")), "no corners"),
        (collection(feature("", box(0, 0, 1, 1))), "a name has 1 to 64"),
        (collection(feature("a\nb", box(0, 0, 1, 1))), "printable"),
        (collection(feature("outside", box(0, 0, 1, 1))), "is not 'outside'"),
        (collection(feature(5, box(0, 0, 1, 1))), "Expected `str`"),
        (collection(feature("a") | {"geometry": {"type": "Point", "coordinates": [0, 0]}}), "Point"),
        (collection(*(feature(f"a{n}", box(0, 0, 1, 1)) for n in range(2001))), "2001 features"),
        (collection(feature("a", [[n, (n % 2) + (n > 0)] for n in range(2001)] + [[0, 0]])), "the limit is 2000"),
        (b" " * (9 << 20), "more than"),
    ],
)
def test_what_is_no_area_is_refused(data: bytes, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        read_areas(data, None)


@pytest.mark.parametrize("turned", [1, -1])
def test_what_two_polygons_of_an_area_share_is_inside(turned: int) -> None:
    """In planners' masks, corrections of maps and lifts, also once written and read again; a hole is one of its own polygon alone."""
    parts = [
        [box(0, 0, 4, 4), box(1, 1, 2, 2)[::turned]],
        [box(3, 0, 8, 4)[::turned]],
        [box(3, 0, 8, 4)],
        [box(8, 4, 9, 5)],
    ]
    drawn: dict[str, Any] = feature("keep", kind="MultiPolygon")
    drawn["geometry"]["coordinates"] = parts
    drawn["properties"] |= {"mask": "keep-out", "lift": "A", "correction": {"kind": "forget"}}
    beside = feature("beside", box(1, 0, 3, 1), box(1.5, 0.25, 2, 0.5))
    beside["properties"] = drawn["properties"] | {"name": "beside"}
    read = read_areas(collection(drawn, beside), None)
    for areas in (read, read_areas(json.dumps(read.geojson("hall")).encode(), None)):
        x, y = np.meshgrid(np.arange(0.025, 10, 0.05), np.arange(0.025, 6, 0.05))
        hole = (x > 1) & (x < 2) & (y > 1) & (y < 2)
        inside = (x < 8) & (y < 4) & ~hole | (x > 8) & (x < 9) & (y > 4) & (y < 5)
        mask = mask_grid(areas, MaskKind.KEEP_OUT)
        cells = np.pad(mask.cells, ((0, 120 - mask.cells.shape[0]), (0, 200 - mask.cells.shape[1])))
        assert ((cells == 100) >= inside).all()
        assert (cells[22:38, 22:38] == 0).all(), "but for cells at its edge the hole is free"
        points = np.c_[x.ravel(), y.ravel(), np.full(x.size, 7.0)]
        np.testing.assert_array_equal(AreaCorrections(areas.areas, areas.areas).is_due(points), inside.ravel())
        here = BuildingFrame(x_m=0.0, y_m=0.0, yaw_rad=0.0)
        lifts = read_lifts(json.dumps(areas.geojson("hall")).encode(), here)
        floor = Floor(FloorEntry(site="hall", level="0", height_m=0.0), here, lifts)
        assert floor.lifts_at(np.array([2.5, 0.5]), 0.0) == floor.lifts_at(np.array([3.5, 2.0]), 0.0) == {"A"}
        assert not floor.lifts_at(np.array([1.5, 1.5]), 0.3)
        assert len({area.name: area for area in areas.areas}["keep"].outlines) == 4
