"""Plans as SVG: the picture of a version with tiles, robots, failures and loops on it; and bar charts. Pure."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from markupsafe import Markup

from fleetmap.geometry import Array
from mapserver.dashboard.markup import joined
from mapserver.dashboard.plan import Plan
from mapserver.floor_plan.areas import Area, Areas


class Mark(NamedTuple):
    """Something at a place of the map: tone gives its colour, shape its form (circle, square, triangle, cross)."""

    x_m: float
    y_m: float
    tone: str
    shape: str
    words: str
    address: str | None = None


class Line(NamedTuple):
    """A line between two places of the map."""

    start_m: tuple[float, float]
    end_m: tuple[float, float]
    tone: str
    words: str


SHAPES = {
    "circle": '<circle r="1"/>',
    "square": '<rect x="-1" y="-1" width="2" height="2"/>',
    "triangle": '<path d="M0-1.2L1.15.9H-1.15Z"/>',
    "cross": '<path class="stroke" d="M-1-1L1 1M-1 1L1-1"/>',
}
_WEAK = 0.5  # of the tracked points agree: below, a person should look
_MARK_SHARE = 0.006  # of the plan's longer side: radius of a mark


def svg(plan: Plan, name: str, layers: Iterable[Markup], *, css: str = "plan") -> Markup:
    """Layers over the extent of a plan. name: what it shows, for those who cannot see it."""
    width, height = plan.size_m
    return Markup(
        '<svg class="{}" viewBox="{:.3f} {:.3f} {:.3f} {:.3f}" role="img" aria-label="{}" style="aspect-ratio:{:.4f}">{}</svg>'
    ).format(css, plan.low_m[0], -plan.high_m[1], width, height, name, width / height, joined(layers))


def site_map(plan: Plan, name: str, picture_address: str, *over: Markup, below: Markup | None = None) -> Markup:
    """A plan with its picture and a scale bar, and layers over or below the picture."""
    return svg(plan, name, [below or Markup(""), ground(plan, picture_address), *over, scale_bar(plan)])


def ground(plan: Plan, picture_address: str) -> Markup:
    """The picture of landmarks and places."""
    width, height = plan.size_m
    return Markup('<image href="{}" x="{:.3f}" y="{:.3f}" width="{:.3f}" height="{:.3f}"/>').format(
        picture_address, plan.low_m[0], -plan.high_m[1], width, height
    )


def scale_bar(plan: Plan) -> Markup:
    """A bar of 1, 2, 5, 10, ... metres in the lower left corner."""
    width, height = plan.size_m
    length_m = next(m for m in (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 1e9) if m >= width / 12)
    x, y, letter = plan.low_m[0] + 0.02 * width, -plan.low_m[1] - 0.03 * height, max(width, height) * 0.018
    return Markup(
        '<g class="scale"><path d="M{:.3f} {:.3f}h{:.3f}"/><text x="{:.3f}" y="{:.3f}" font-size="{:.3f}">{:g} m</text></g>'
    ).format(x, y, length_m, x, y - 0.5 * letter, letter, length_m)


def coverage(plan: Plan) -> Markup:
    """Tiles, the fuller the darker."""
    most = max((tile.landmarks for tile in plan.tiles), default=1) or 1
    words = [f"tile {tile.x},{tile.y}: {tile.landmarks} landmarks" for tile in plan.tiles]
    named = zip(plan.tiles, words, strict=True)
    return joined(_cell(plan, (tile.x, tile.y), "tile", name, tile.landmarks / most) for tile, name in named)


def areas(plan: Plan, found: Areas) -> Markup:
    """Outlines of named areas, with their names where these have room."""
    letter = 0.014 * max(plan.size_m)
    return joined(_area(area, letter) for area in reversed(found.areas))


def _area(area: Area, letter: float) -> Markup:
    ways = "".join("M" + "L".join(f"{x:.3f} {-y:.3f}" for x, y in ring.tolist()) + "Z" for ring in area.rings)
    (x0, y0), (x1, y1) = area.rings[0].min(axis=0), area.rings[0].max(axis=0)
    across, upright = x1 - x0, y1 - y0
    x, y, length = (x0 + x1) / 2, -(y0 + y1) / 2, 0.6 * letter * len(area.name)  # as wide as letters usually are
    words = Markup("")
    if max(across, upright) > length and min(across, upright) > letter:
        turned = (
            Markup("")
            if across >= min(length, upright)
            else Markup(' transform="rotate(-90 {:.3f} {:.3f})"').format(x, y)
        )
        words = Markup('<text x="{:.3f}" y="{:.3f}" font-size="{:.3f}"{}>{}</text>').format(
            x, y, letter, turned, area.name
        )
    return Markup('<g class="area"><path fill-rule="evenodd" d="{}"><title>{}</title></path>{}</g>').format(
        ways, area.name, words
    )


def cells(plan: Plan, kinds: Mapping[tuple[int, int], str]) -> Markup:
    """Tiles by what became of them: added, changed or removed."""
    placed = sorted(kinds.items())
    return joined(_cell(plan, place, kind, f"tile {place[0]},{place[1]}: {kind}", 1.0) for place, kind in placed)


def _cell(plan: Plan, place: tuple[int, int], css: str, words: str, fullness: float) -> Markup:
    size = plan.tile_size_m
    return Markup(
        '<rect class="cell {}" x="{:.3f}" y="{:.3f}" width="{:.3f}" height="{:.3f}" style="--full:{:.3f}"><title>{}</title></rect>'
    ).format(css, place[0] * size, -(place[1] + 1) * size, size, size, fullness, words)


def marks(plan: Plan, found: Iterable[Mark]) -> Markup:
    """Marks, the last ones on top."""
    radius = _MARK_SHARE * max(plan.size_m)
    return joined(_mark(mark, radius) for mark in found)


def _mark(mark: Mark, radius: float) -> Markup:
    drawn = Markup(
        '<g class="mark {}" transform="translate({:.3f} {:.3f}) scale({:.4f})"><title>{}</title>{}</g>'
    ).format(mark.tone, mark.x_m, -mark.y_m, radius, mark.words, Markup(SHAPES[mark.shape]))
    if mark.address is None:
        return drawn
    return Markup('<a href="{}" aria-label="{}">{}</a>').format(mark.address, mark.words, drawn)


def lines(found: Iterable[Line]) -> Markup:
    """Lines, the last ones on top."""
    return joined(
        Markup('<path class="line {}" d="M{:.3f} {:.3f}L{:.3f} {:.3f}"><title>{}</title></path>').format(
            line.tone, line.start_m[0], -line.start_m[1], line.end_m[0], -line.end_m[1], line.words
        )
        for line in found
    )


def dots(points_m: Array, size_m: float) -> Markup:
    """Points (N, 2) as one path of round dots."""
    steps = "".join(f"M{x:.2f} {-y:.2f}h0" for x, y in points_m.tolist())
    return Markup('<path class="dots" d="{}" stroke-width="{:.3f}"/>').format(steps, size_m)


def trail(path: Array, width_m: float) -> Markup:
    """A way (N, 3) x, y and quality from 0 to 1: neighbouring stretches of one tone are one line."""
    tones = ["bad" if q <= 0 else "warn" if q < _WEAK else "good" for q in path[:, 2].tolist()]
    drawn, start = [], 1
    for n in range(1, len(tones)):
        if n + 1 == len(tones) or tones[n + 1] != tones[n]:
            way = "L".join(f"{x:.3f} {-y:.3f}" for x, y, _ in path[start - 1 : n + 1].tolist())
            drawn.append(
                Markup('<path class="trail {}" d="M{}" stroke-width="{:.3f}"/>').format(tones[n], way, width_m)
            )
            start = n + 1
    return joined(drawn)


class Bar(NamedTuple):
    """A rate with its interval; value None where nothing was driven."""

    label: str
    value: float | None
    low: float | None
    high: float | None
    words: str


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, 20, ..."""
    steps = (digit * 10.0**power for power in range(-1, 9) for digit in (1, 2, 5))
    return next((step for step in steps if step >= value), value)


def bars(found: list[Bar], name: str) -> Markup:
    """Rates side by side with the intervals that hold the true ones; those that are very wide go beyond the scale."""
    width, height, foot, left = 640.0, 150.0, 20.0, 44.0
    highest = max([0.5, *(bar.value for bar in found if bar.value is not None)])
    top = _round_up(min(3 * highest, max([highest, *(bar.high for bar in found if bar.high is not None)])))
    step = (width - left) / max(len(found), 1)

    def y(value: float) -> float:
        return (height - foot) * (1 - min(value, top) / top) + 6

    parts = [
        Markup(
            '<path class="axis" d="M{0} {1:.1f}H{2}"/><text x="{3}" y="{4:.1f}" text-anchor="end">{5:g}</text>'
        ).format(left, y(value), width, left - 6, y(value) + 4, round(value, 2))
        for value in (0.0, top / 2, top)
    ]
    for number, bar in enumerate(found):
        x = left + (number + 0.5) * step
        label = Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="middle">{}</text>')
        parts.append(label.format(x, height + 4, bar.label))
        if bar.value is None or bar.low is None or bar.high is None:
            continue
        parts.append(
            Markup(
                '<g><title>{}</title><rect class="bar" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}"/>'
                '<path class="whisker" d="M{:.1f} {:.1f}V{:.1f}"/></g>'
            ).format(
                bar.words, x - 0.3 * step, y(bar.value), 0.6 * step, y(0) - y(bar.value), x, y(bar.low), y(bar.high)
            )
        )
    return Markup('<svg class="bars" viewBox="0 0 {:g} {:g}" role="img" aria-label="{}">{}</svg>').format(
        width, height + 8, name, joined(parts)
    )
