"""Which way a map was seen: aisles driven one way, both ways, over the border of tiles, and turns that are no aisles."""

from collections.abc import Sequence

import numpy as np
import pytest

from fleetmap.geometry import Array, se3
from mapserver.quality.directions import HEADINGS, missing_words, one_way_words, tile_directions
from mapserver.quality.figures import TileDirections

SIZE_M = 16.0


def looking(heading_deg: float, x_m: float, y_m: float, up_deg: float = 0.0) -> Array:
    """map_from_cam of a camera that looks along a heading (0 is E, 90 is N), upwards by so much."""
    heading, up = np.radians([heading_deg, up_deg])
    forward = np.array([np.cos(heading) * np.cos(up), np.sin(heading) * np.cos(up), np.sin(up)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    return se3(np.column_stack([right, np.cross(forward, right), forward]), np.array([x_m, y_m, 1.2]))


def aisle(heading_deg: float, y_m: float, low_m: float = 1.0, high_m: float = 15.0) -> list[Array]:
    return [looking(heading_deg, x_m, y_m) for x_m in np.arange(low_m, high_m, 0.5)]


def tiles_of(cameras: Sequence[Array]) -> dict[tuple[int, int], Array]:
    """The places by their tiles."""
    cells: dict[tuple[int, int], list[Array]] = {}
    for map_from_cam in cameras:
        x, y = np.floor(map_from_cam[:2, 3] / SIZE_M).astype(int)
        cells.setdefault((int(x), int(y)), []).append(map_from_cam)
    return {cell: np.array(cells[cell]) for cell in sorted(cells)}


@pytest.mark.parametrize("sector", range(8))
def test_an_aisle_driven_one_way_names_the_other(sector: int) -> None:
    direction = np.array([np.cos(sector * np.pi / 4), np.sin(sector * np.pi / 4)])
    places = [looking(45.0 * sector + 10.0, *(8.0 + along_m * direction)) for along_m in np.linspace(-4, 4, 17)]
    other = HEADINGS[(sector + 4) % 8]
    assert tile_directions(tiles_of(places)) == [TileDirections((0, 0), {HEADINGS[sector]: 17}, {other: 17})]


@pytest.mark.parametrize(
    ("places", "found"),
    [
        # Lanes a metre apart, and the second robot looks a little aside
        (aisle(0, 4.0) + aisle(200, 5.0), [TileDirections((0, 0), {"E": 28, "W": 28}, {})]),
        # The next aisle does not count: both ways are seen, and missing
        (aisle(0, 4.0) + aisle(180, 8.0), [TileDirections((0, 0), {"E": 28, "W": 28}, {"E": 28, "W": 28})]),
        # Lanes on both sides of a tile's border are one aisle; the order is that of the tiles
        (
            aisle(0, 15.5) + aisle(180, 16.5),
            [TileDirections((0, 0), {"E": 28}, {}), TileDirections((0, 1), {"W": 28}, {})],
        ),
        ([looking(0, 1.0 + k, 4.0, up_deg=85.0) for k in range(10)], []),  # without a heading
    ],
)
def test_two_drives(places: list[Array], found: list[TileDirections]) -> None:
    assert tile_directions(tiles_of(places)) == found
    assert (one_way_words(found) == "") == (not any(tile.missing for tile in found))


def test_the_half_that_was_driven_both_ways_is_not_missing() -> None:
    (found,) = tile_directions(tiles_of(aisle(0, 4.0) + aisle(180, 4.5, high_m=8.0)))
    assert found.seen == {"E": 28, "W": 14}
    assert set(found.missing) == {"W"}
    assert 8 <= found.missing["W"] <= 12


def test_a_turn_on_the_spot_is_no_aisle() -> None:
    turn = [looking(heading, 8.0, 4.0) for heading in range(0, 180, 12)]
    (found,) = tile_directions(tiles_of(turn))
    assert found.missing == {}
    assert sum(found.seen.values()) == len(turn)


def test_tiles_without_places_are_left_out() -> None:
    assert tile_directions({(0, 0): np.zeros((0, 4, 4))}) == []
    assert tile_directions({}) == []


def test_the_words_name_the_tile_and_the_heading() -> None:
    words = one_way_words(tile_directions(tiles_of(aisle(0, 4.0))))
    assert words.startswith("1 of 1 tiles hold places that were seen one way only (tile 0,0: 28 places face E")
    many = tile_directions(tiles_of([camera for k in range(3) for camera in aisle(0, 4.0 + SIZE_M * k)]))
    assert "3 of 3 tiles" in one_way_words(many)
    assert "tile 0,1: 28 places" in one_way_words(many)
    assert one_way_words(many).endswith("; and 1 more)")
    assert missing_words(TileDirections((0, 0), {"E": 3}, {})) == ""
