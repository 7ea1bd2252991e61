"""The list of failures: what fails, and is it one or many? Causes over time, counts by cause, place, version and robot, cards."""

import time
from bisect import bisect
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

from fleetmap.errors import UsageError
from fleetmap.messages import Cause, FailureKind
from mapserver.api.incidents import incidents, of_failure
from mapserver.api.moments import read_moment
from mapserver.dashboard.console import PageContext, Services, number, scene_of
from mapserver.dashboard.fleet_health import FAILURES_SHOWN, MANY_FAILURES, places_of
from mapserver.dashboard.fleet_parts import bar_edges, page_of
from mapserver.dashboard.map_layers import Layer, Mark
from mapserver.fleet.alerts import Incident, with_acts
from mapserver.store import EVER, FailureFilter, FailureRow

AXES = {"cause": "Cause", "area": "Area", "tile": "Tile", "version": "Map version", "robot": "Robot"}
_SHADES = 6  # of causes; the last is that of all others
Chosen = Mapping[str, str]
"""Values by axis; none of those that everything may have."""


class Facet(NamedTuple):
    """An axis by which failures are chosen.

    choices: values, how many failures choosing each shows, and the address that does so; of a chosen one, that which takes the choice back;
    then how many of today, and their address, as long as no time is chosen.
    """

    axis: str
    title: str
    chosen: str | None
    choices: list[tuple[str, int, str, int, str]]


ADVICE: dict[str, str] = {
    Cause.CARRIED: "The robot was carried: what it sees ended between two images, and its fixes agree on another place.",
    Cause.ALIASED: "Several places of the map look like what the robot sees. Something that differs, a dock or a coarse position tells "
    "them apart.",
    Cause.MAP_CHANGED: "Images and odometry are sound, but far fewer landmarks are there than the map holds: survey this place again.",
    Cause.CALIBRATION: "The cameras do not agree with the map any more: check their mounting, then calibrate the robot.",
    Cause.OVERLOADED: "The robot's computer is too slow and drops its frames: end other programs on it, or lower the frame rate.",
    Cause.DARK: "The images are dark: check the light and the lenses.",
    Cause.NO_MATCH: "Nothing in the map agrees: not mapped, or mapped in the other direction only.",
}
"""What a cause means and what to do, where there is more to say than its name."""


def page(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    kept = {name: value for name, value in context.query.items() if name not in {"site", "older"}}
    if kept.get("sort") not in (None, "happened"):
        raise UsageError(
            f"sort={kept['sort'][:40]!r} is unknown; write sort=happened, or leave it out for the last to arrive first"
        )
    version = number(kept.get("version"), "version")
    chosen = {axis: kept[axis] for axis in AXES if kept.get(axis)}
    if version is not None:
        chosen["version"] = str(version)  # 07 is 7
    since_ns, until_ns = context.time_range()
    in_time = FailureFilter(site=context.site, since_ns=since_ns, until_ns=until_ns)
    wanted = replace(in_time, **{**chosen, "version": version})  # type: ignore[arg-type]  # the others are texts
    before, maps = number(context.query.get("older"), "failure"), services.maps
    kept_failures = maps.store.fleet
    rows = kept_failures.failures(in_time, limit=MANY_FAILURES)
    matching = [row for row in rows if _fits(row, chosen)]
    if kept.get("sort") == "happened":
        found = sorted(matching, key=lambda row: (-row.happened_ns, -row.number))
        found = found[next((n + 1 for n, row in enumerate(found) if row.number == before), 0) :]
    else:
        found = kept_failures.failures(wanted, before=before, limit=FAILURES_SHOWN + 1)
    shown = found[:FAILURES_SHOWN]
    dense = {"Density": places_of(matching)}
    is_kept = version is not None and services.maps.has_version(context.site, version)
    drawn = version if is_kept else services.maps.current_version(context.site)
    facets = _facets(context, rows, chosen, kept, services.maps.store.areas(context.site).names)
    open_ones = incidents(maps.store, services.robots.fleet, services.settings.config.alerts, maps.inbox, context.site)
    causes = next((facet.choices for facet in facets if facet.axis == "cause"), [])
    shades = {cause: min(n, _SHADES - 1) for n, (cause, *_) in enumerate(causes)}
    return {
        "answer": _answer(matching),
        "is_chosen": any(value for name, value in kept.items() if name != "sort"),
        "sorts": [
            (words, is_chosen, context.to("failures", **{**kept, "sort": value}))
            for value, words in ((None, "arrived"), ("happened", "happened"))
            for is_chosen in [kept.get("sort") == value]
        ],
        "facets": facets,
        "shades": shades,
        "advice": ADVICE,
        "chart": _chart(context, matching, shades, kept) if matching else None,
        # where the listed ones are, and where all that match are dense
        "scene": scene_of(services, context, drawn, [Layer("Failures", failure_marks(context, shown))], dense_m=dense),
        "rows": shown,
        "held": held(services, shown),
        "incidents": [
            (one, context.to(page_of(one))) for one in sorted(open_ones, key=lambda one: one.state != "open")
        ],
        "pictures": kept_failures.first_pictures(row.number for row in shown),
        "older": context.to("failures", **kept, older=shown[-1].number) if len(found) > len(shown) else None,
    }


def held(services: Services, rows: Iterable[FailureRow]) -> dict[str, Incident]:
    """Failures as incidents, by number."""
    return {one.about: one for one in with_acts(services.maps.store, map(of_failure, rows))}


def _value(row: FailureRow, axis: str) -> str:
    return str(getattr(row, axis) or "")


def _fits(row: FailureRow, chosen: Chosen, but: str = "") -> bool:
    """Whether a failure has what is chosen on all axes but one."""
    return all(axis == but or _value(row, axis) == value for axis, value in chosen.items())


def _answer(found: Sequence[FailureRow]) -> str:
    """One or many: what most of them share; empty for none."""
    if not found:
        return ""
    suspected = sum(row.kind == FailureKind.SUSPECTED for row in found)
    told = f"{'The last ' * (len(found) >= MANY_FAILURES)}{len(found)} failure{'s' * (len(found) > 1)}"
    told += f", {suspected} of them suspected" if suspected else ""
    robots, parts = len({row.robot for row in found}), []
    for link, values in (
        ("", [row.cause.replace("_", " ") for row in found]),
        ("in ", [row.where for row in found]),
        ("of ", [row.robot for row in found]),
    ):
        (most, count), (_, second) = [*Counter(value or "unknown" for value in values).most_common(2), ("", 1)][:2]
        parts += [f"{link}{most} ({count})"] if count > second else []
    told += f" of {robots} robots" if robots > 1 else ""
    return f"{told}. Most: {', '.join(parts)}." if parts else f"{told}."


def _facets(
    context: PageContext, rows: Sequence[FailureRow], chosen: Chosen, kept: Chosen, areas: Sequence[str]
) -> list[Facet]:
    """For each axis its values, those with most failures first. kept: query parameters."""
    found, day = [], read_moment(context.today, "today", context.zone) or 0
    of_today = [row for row in rows if row.happened_ns >= day] if context.time_range() == EVER else []
    for axis, title in AXES.items():
        own = chosen.get(axis)
        counts = Counter(dict.fromkeys(areas if axis == "area" else (), 0))
        counts.update([] if own is None else {own: 0})
        all_days, today = (
            Counter(_value(row, axis) for row in of if _fits(row, chosen, axis)) for of in (rows, of_today)
        )
        counts.update({value: count for value, count in all_days.items() if value})
        if not counts or (axis == "tile" and areas and not own):
            continue
        choices = []
        for value, count in counts.most_common():
            to = {**kept, axis: None if value == own else value}
            to_today = {**kept, axis: value, "since": context.today, "until": None}
            addresses = [context.to("failures", **query) for query in (to, to_today)]
            choices.append((value, count, addresses[0], today[value], addresses[1]))
        found.append(Facet(axis, title, own, choices))
    return found


def _chart(
    context: PageContext, rows: Sequence[FailureRow], shades: Mapping[str, int], kept: Chosen
) -> dict[str, object]:
    """Failures over time in bars, parted by cause; in percent of the highest. A bar leads to its time. kept: query parameters."""
    since_ns, until_ns = context.time_range()
    times = [row.happened_ns for row in rows]
    first_ns, end_ns = since_ns or min(times), until_ns or max(time.time_ns(), max(times) + 1)
    edges, step = bar_edges(first_ns, end_ns, context.zone)
    counts = [Counter[str]() for _ in edges[1:]]
    for row in rows:
        counts[bisect(edges, row.happened_ns) - 1][row.cause] += 1
    most, bars = max(count.total() for count in counts), []
    for (start_ns, stop_ns), count in zip(pairwise(edges), counts, strict=True):
        parts, below = [], 0
        for cause, part in sorted(count.items(), key=lambda item: shades.get(item[0], _SHADES - 1)):
            below += part
            parts.append(
                {"shade": shades.get(cause, _SHADES - 1), "top": 100 - 100 * below / most, "height": 100 * part / most}
            )
        told = ", ".join(f"{part} {cause.replace('_', ' ') or 'unknown'}" for cause, part in count.most_common())
        span = {"since": context.written(start_ns), "until": context.written(stop_ns)}
        words = f"{context.moment(start_ns)}, {step}: {told or 'none'}"
        bars.append({"words": words, "parts": parts, "to": context.to("failures", **{**kept, **span})})
    ends = [context.written(ns)[:16].replace("T", " ") for ns in (edges[0], end_ns)]
    return {"bars": bars, "most": most, "step": step, "ends": ends, "span": (edges[0], edges[-1])}


def failure_marks(context: PageContext, shown: Sequence[FailureRow]) -> list[Mark]:
    """Crosses at the failures that have a position."""
    found = []
    for row in reversed(shown):
        if row.x_map_m is not None and row.y_map_m is not None:
            words, to_failure = f"failure {row.number}: {row.robot}, {row.cause}", context.to(f"failures/{row.number}")
            found.append(Mark(row.x_map_m, row.y_map_m, tone_of(row), "cross", words, to_failure))
    return found


def tone_of(row: FailureRow) -> str:
    """The tone of a failure: a suspected one is an estimate."""
    return "warn" if row.kind == FailureKind.SUSPECTED else "bad"
