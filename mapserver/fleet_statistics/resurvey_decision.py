"""Tiles to resurvey, and a route through them. Pure.

A tile is listed if robots fail clearly more often there than before (or, without earlier data, than elsewhere on the site), or if they
find clearly fewer of the expected landmarks.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import scipy

from fleetmap.config import Positive, Section
from mapserver.fleet_statistics.kpis import Counters, Rate, kpis, rate

_ALPHA = 0.01  # probability that any tile of an unchanged site is listed
_MIN_LANDMARKS = 2000  # expected in both periods, for their share to count


class ResurveySettings(Section, frozen=True):
    """Recent and earlier periods, and thresholds of worsening.

    rising_ratio: factor by which the earlier rate must be exceeded, at a significance of 1 %; fading: drop of the share of found landmarks.
    requests: the server itself requests surveys of what is listed.
    """

    recent_days: Positive = 2.0
    before_days: Positive = 14.0
    min_failures: Annotated[int, msgspec.Meta(ge=1)] = 3
    rising_ratio: Annotated[float, msgspec.Meta(ge=1)] = 1.5
    fading: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.15
    requests: bool = False


@dataclass(frozen=True, slots=True)
class TileConcern:
    """A tile "x,y" to resurvey. landmarks_seen_*: found share of expected landmarks, None without any.

    name: the tile's name by its areas.
    """

    tile: str
    reasons: list[str]
    failures: Rate
    failures_before: Rate
    landmarks_seen_share: float | None
    landmarks_seen_share_before: float | None
    name: str = ""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A position to drive to, in `map`."""

    tile: str
    x_map_m: float
    y_map_m: float
    reason: str
    name: str = ""


def concerns(
    recent: Mapping[str, Counters], before: Mapping[str, Counters], settings: ResurveySettings
) -> list[TileConcern]:
    """Return the tiles to resurvey, the most urgent first. recent, before: sums by tile."""
    total = Counters()
    for counts in recent.values():
        total.add(counts)
    tests = max(1, len(recent))
    found = []
    for tile, now in recent.items():
        if "," not in tile:
            continue
        then = before.get(tile, Counters())
        concern = concern_of(tile, _rising(now, then, total, settings, tests), now, then)
        new, old = concern.landmarks_seen_share, concern.landmarks_seen_share_before
        is_seen = min(now.landmarks_expected, then.landmarks_expected) >= _MIN_LANDMARKS
        if new is not None and old is not None and is_seen and new < old - settings.fading:
            concern.reasons.append(f"{new:.0%} of the landmarks are found, {old:.0%} before")
        found += [concern] if concern.reasons else []
    return sorted(found, key=lambda concern: (-concern.failures.events, concern.tile))


def concern_of(tile: str, reasons: list[str], now: Counters, then: Counters) -> TileConcern:
    """Return a tile with its counts, recent and before."""
    old, new = kpis(then).landmarks_seen_share, kpis(now).landmarks_seen_share
    both = (rate(now.events, now.robot_days), rate(then.events, then.robot_days))
    return TileConcern(tile, reasons, *both, new, old, f"tile {tile}")


def route(concerned: Sequence[TileConcern], places: Mapping[str, tuple[float, float]]) -> list[Waypoint]:
    """Return a route through the tiles, always to the nearest remaining one, from the worst on. places: target in each tile."""
    left = [concern for concern in concerned if concern.tile in places]
    way: list[Waypoint] = []
    while left:
        here = (way[-1].x_map_m, way[-1].y_map_m) if way else places[left[0].tile]
        best = min(left, key=lambda concern: (math.dist(here, places[concern.tile]), concern.tile))
        left.remove(best)
        way.append(Waypoint(best.tile, *places[best.tile], "; ".join(best.reasons), best.name))
    return way


def route_csv(way: Sequence[Waypoint]) -> str:
    """Return the route as CSV: one waypoint a line, metres in `map`."""
    text = io.StringIO()
    write = csv.writer(text, lineterminator="\n").writerow
    write(("number", "x_map_m", "y_map_m", "tile", "reason"))
    for number, point in enumerate(way, start=1):
        reason = " ".join(point.reason.split())
        guard = "'" * reason.startswith(
            ("=", "+", "-", "@")
        )  # people choose words: none begins a formula of a spreadsheet
        write((number, f"{point.x_map_m:.3f}", f"{point.y_map_m:.3f}", point.tile, guard + reason))
    return text.getvalue()


def route_geojson(site: str, version: int, way: Sequence[Waypoint]) -> dict[str, Any]:
    """Return the route as GeoJSON (RFC 7946), with metres in `map` instead of degrees."""
    points: list[dict[str, Any]] = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [round(p.x_map_m, 3), round(p.y_map_m, 3)]},
            "properties": {"number": number, "tile": p.tile, "name": p.name, "reason": p.reason},
        }
        for number, p in enumerate(way, start=1)
    ]
    line = [point["geometry"]["coordinates"] for point in points]
    lines = [{"type": "Feature", "geometry": {"type": "LineString", "coordinates": line}, "properties": {}}]
    about = {"type": "FeatureCollection", "site": site, "version": version, "units": "metres in map"}
    return about | {"features": points + (lines if len(line) > 1 else [])}


def _rising(now: Counters, then: Counters, total: Counters, settings: ResurveySettings, tests: int) -> list[str]:
    """Apply the exact conditional test of two Poisson rates, with Bonferroni's correction over the site's tiles.

    Source: Przyborowski and Wilenski 1940.
    """
    if now.events < settings.min_failures:
        return []
    elsewhere_days = total.robot_days - now.robot_days
    if then.driving_ms > 0:
        events, days, words = then.events, then.robot_days, "before"
    elif elsewhere_days > 0:
        events, days, words = total.events - now.events, elsewhere_days, "elsewhere on the site"
    else:
        return []
    odds = settings.rising_ratio * max(now.robot_days, 1e-6) / days
    chance = float(scipy.special.betainc(now.events, events + 1, odds / (1 + odds)))
    if chance * tests > _ALPHA:
        return []
    driven = f"{now.driving_ms / 3.6e6:.1f} h of driving"
    return [f"{now.events} failures in {driven}, {events} in {days * 16:.1f} h {words}"]
