"""What interactive maps show, in metres of `map`: pictures, squares, areas, lines, dots and marks, in named layers. Pure.

Maps draw these by `static/map/index.js`; the field `kind` says how.
"""

import base64
from collections.abc import Iterable, Sequence

import cv2
import msgspec
import numpy as np

from fleetmap.geometry import Array
from mapserver.dashboard.plan import Box, Plan, inked, png
from mapserver.floor_plan.areas import Areas

_WEAK = 0.5  # of the tracked points agree: below, a person should look
_HEAT_CELL_M, _HEAT_SIGMA_M, _HEAT_CELLS = 0.5, 2.0, 1000
_MARGIN_M, _SMALLEST_M = 3.0, 10.0  # of what is in sight around places
_HEAT_BGR = (32, 60, 220)
_DIRECTIONS_RAD = {"E": 0.0, "N": np.pi / 2, "W": np.pi, "S": -np.pi / 2}


class _Drawn(msgspec.Struct, frozen=True, tag_field="kind", tag=str.lower):
    """Its kind is the name of its class."""


class Picture(_Drawn, frozen=True):
    """A picture over a box; tone `ink`: drawn in middle grey, which pages lighten on dark ground."""

    url: str
    box: Box
    tone: str = "ink"


class Square(_Drawn, frozen=True):
    """A square of the map. full: from 0 to 1, how dark."""

    box: Box
    tone: str
    words: str
    full: float = 1.0


class Outline(_Drawn, frozen=True, tag="area"):
    """A named area. tone: of one that corrects the map."""

    rings: list[list[tuple[float, float]]]
    words: str
    tone: str = ""


class Line(_Drawn, frozen=True):
    """A line through places. width: pixels; hue: degrees, in the place of the tone's colour."""

    points: list[tuple[float, float]]
    tone: str
    words: str = ""
    width: float = 2.5
    hue: int | None = None


class Dots(_Drawn, frozen=True):
    """Many places; points: x and y in turn."""

    points: list[float]


class Mark(_Drawn, frozen=True):
    """Something at a place. tone: its colour; shape: circle, square, triangle, cross or arrow; words: said where the pointer is.

    name: is written beside it where there is room, and what marks are told apart by when they move. heading_rad: from x towards y.
    """

    x: float
    y: float
    tone: str
    shape: str
    words: str
    address: str | None = None
    name: str = ""
    heading_rad: float | None = None


Item = Picture | Square | Outline | Line | Dots | Mark


class Layer(msgspec.Struct, frozen=True):
    """Items that are shown or hidden together, by a name that people see."""

    name: str
    items: Sequence[Item] = ()
    shown: bool = True


def box_around(places_m: Sequence[tuple[float, float]], box: Box) -> Box:
    """The part of a map's box around places, with room beside them; all of it where none of them lies in it."""
    inside = [(x, y) for x, y in places_m if box[0] <= x <= box[2] and box[1] <= y <= box[3]]
    if not inside:
        return box
    sides = []
    for axis in (0, 1):
        low, high = (bound(place[axis] for place in inside) for bound in (min, max))
        half_m = max((high - low) / 2 + _MARGIN_M, _SMALLEST_M / 2)
        sides.append(((low + high) / 2 - half_m, (low + high) / 2 + half_m))
    (x0, x1), (y0, y1) = sides
    return (x0, y0, x1, y1)


def with_areas(box: Box, areas: Areas) -> Box:
    """A map's box and the named areas, which may lie beyond all landmarks."""
    corners = np.concatenate([np.reshape(box, (2, 2)), *(ring for area in areas.areas for ring in area.rings)])
    (x0, y0), (x1, y1) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    return (x0, y0, x1, y1)


def ground(
    plan: Plan, picture_address: str, areas: Areas, below: Sequence[Layer] = (), *, shows_coverage: bool = False
) -> list[Layer]:
    """What every map has: pictures of the building below, then landmarks and places, names of areas, coverage and directions."""
    return [
        *below,
        Layer("Coverage", coverage(plan), shown=shows_coverage),
        Layer("Landmarks and places", [Picture(picture_address, plan.box)]),
        Layer("Areas", outlines(areas)),
        Layer("Directions surveyed", directions(plan), shown=False),
    ]


def outlines(areas: Areas) -> list[Outline]:
    """Named areas, the smallest last, so that it is on top."""
    drawn = []
    for area in reversed(areas.areas):
        words, tone = (area.name, "") if area.correction is None else (f"{area.name} ({area.correction.kind})", "warn")
        rings = [[(round(x, 3), round(y, 3)) for x, y in ring.tolist()] for ring in area.rings]
        drawn.append(Outline(rings, words, tone))
    return drawn


def coverage(plan: Plan) -> list[Square]:
    """Tiles, the fuller the darker."""
    most = max((tile.landmarks for tile in plan.tiles), default=1) or 1
    return [
        square(plan, (t.x, t.y), "tile", f"{t.landmarks} landmarks", full=round(t.landmarks / most, 3))
        for t in plan.tiles
    ]


def square(plan: Plan, place: tuple[int, int], tone: str, words: str, *, full: float = 1.0) -> Square:
    """A tile's square; words: what is said of the tile."""
    (x, y), size = place, plan.tile_size_m
    return Square((x * size, y * size, (x + 1) * size, (y + 1) * size), tone, f"tile {x},{y}: {words}", full)


def directions(plan: Plan) -> list[Mark]:
    """An arrow for each heading that places of a tile look, in a warning tone for those that nothing looks."""
    found = []
    for tile in plan.directions:
        x, y = ((cell + 0.5) * plan.tile_size_m for cell in tile.tile)
        for heading, count in (*tile.seen.items(), *tile.missing.items()):
            angle = _DIRECTIONS_RAD.get(heading)
            if angle is None:
                continue
            missing = heading not in tile.seen
            words = f"nothing looks {heading}" if missing else f"{count} places look {heading}"
            at = x + 0.2 * plan.tile_size_m * np.cos(angle), y + 0.2 * plan.tile_size_m * np.sin(angle)
            tone = "warn" if missing else "accent"
            found.append(Mark(float(at[0]), float(at[1]), tone, "arrow", words, heading_rad=float(angle)))
    return found


def trail(path: Array, width: float = 3.0, *, hue: int | None = None) -> list[Line]:
    """A way (N, 3) x, y and quality from 0 to 1: neighbouring stretches of one tone are one line."""
    tones = ["bad" if q <= 0 else "warn" if q < _WEAK else "good" for q in path[:, 2].tolist()]
    drawn, start = [], 1
    for n in range(1, len(tones)):
        if n + 1 == len(tones) or tones[n + 1] != tones[n]:
            way = [(round(x, 3), round(y, 3)) for x, y, _ in path[start - 1 : n + 1].tolist()]
            drawn.append(Line(way, tones[n], width=width, hue=hue))
            start = n + 1
    return drawn


def heat(places_m: Iterable[tuple[float, float]], box: Box) -> list[Picture]:
    """Where things happened, as a picture: the sum of a bell of 2 m around each place, the densest opaque; none for no places."""
    low, high = np.array(box[:2]), np.array(box[2:])
    cell_m = max(_HEAT_CELL_M, float((high - low).max()) / _HEAT_CELLS)
    width, height = np.maximum(np.ceil((high - low) / cell_m).astype(int), 1).tolist()
    counts = np.zeros((height, width), np.float32)
    for x, y in places_m:
        column, row = int((x - low[0]) // cell_m), int((high[1] - y) // cell_m)
        if 0 <= column < width and 0 <= row < height:
            counts[row, column] += 1
    if not counts.any():
        return []
    counts = cv2.GaussianBlur(counts, (0, 0), _HEAT_SIGMA_M / cell_m, borderType=cv2.BORDER_CONSTANT)
    picture = inked(220 * np.sqrt(counts / counts.max()), _HEAT_BGR)
    url = f"data:image/png;base64,{base64.b64encode(png(picture)).decode()}"
    return [Picture(url, (box[0], box[3] - height * cell_m, box[0] + width * cell_m, box[3]), "heat")]
