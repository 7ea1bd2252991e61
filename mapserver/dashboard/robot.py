"""The page of a robot: what has it been doing? A band of its states, its way and its figures in a time; a stream tells what it is now."""

import time
from collections import defaultdict
from collections.abc import Sequence
from math import dist
from statistics import fmean
from typing import NamedTuple

from fleetmap.errors import UsageError
from fleetmap.messages import Flag
from mapserver.dashboard.console import PageContext, Services, scene_of
from mapserver.dashboard.failures import ADVICE, failure_marks, tone_of
from mapserver.dashboard.fleet_health import FAILURES_SHOWN
from mapserver.dashboard.fleet_parts import Sentence
from mapserver.dashboard.live import ORDER, SILENT, LiveRobot, words_of
from mapserver.dashboard.map_layers import Layer, Line
from mapserver.dashboard.overview import alerts_of, remarks, since_words
from mapserver.fleet_statistics.kpis import hour_of
from mapserver.fleet_statistics.robot_calibration import PARAMETERS
from mapserver.store import EVER, FailureFilter, TraceRow

_USUAL_NS = 24 * 3_600_000_000_000
_TICKS, _BAND_PARTS = 5, 400
_FIGURES = (
    ("CPU of a frame, mean", "frame_ms_mean", "{:.1f} ms"),
    ("CPU of a frame, slowest of a hundred", "frame_ms_p99", "{:.1f} ms"),
    ("Frames that it is too slow for", "frames_dropped_share", "{:.0%}"),
    ("Brightness of the image (0 to 1)", "exposure", "{:.2f}"),
    ("Sharpness (1 is usual)", "sharpness", "{:.2f}"),
    ("Believed uncertainty (95 % radius)", "radius_95_m", "{:.2f} m"),
    ("Protection level of the position", "protection_m", "{:.2f} m"),
    ("Protection level of the heading", "protection_deg", "{:.1f}°"),
    ("Speed", "speed_mps", "{:.2f} m/s"),
    ("Failure reports that wait", "spool_waiting", "{:.0f}"),
)
_CURVES = (("CPU of a frame", "frame_ms", "{:.1f} ms"), *_FIGURES[3:5])  # and brightness and sharpness
# What to do, by what it reports, else by its state in words.
_ADVICE = ADVICE | {
    Flag.OFF_MAP: "The map has no tile where it is: survey this place, or drive it back.",
    "lost": "Drive it to where the map was surveyed, or say where it stands.",
    "several places fit": "Drive it some metres, or say where it stands.",
    "starting": "Drive it a metre, or say where it stands.",
    "offline": "Look whether it is switched on and reaches this server; `locclient check` on it says what is missing.",
}
GAP_NS = 45_000_000_000
"""A row is kept at least each ten seconds: after so long without one the robot was silent."""

_COLUMNS = 300  # of a curve
_STEP_M = 0.5
_PAUSE_NS, _AROUND_NS = 600_000_000_000, 60_000_000_000


class Stretch(NamedTuple):
    """From when until when a robot had one status, version and set of flags; status "" where nothing was heard.

    is_mixed: others were between, too short to be seen.
    """

    since_ns: int
    until_ns: int
    status: str
    version: int | None = None
    flags: str = ""
    is_mixed: bool = False

    @property
    def length_ns(self) -> int:
        return self.until_ns - self.since_ns

    @property
    def state(self) -> tuple[str, str]:
        """The status in words, and its tone."""
        return words_of(self.status) if self.status else SILENT


def stretches(rows: Sequence[TraceRow], until_ns: int) -> list[Stretch]:
    """The stretches, oldest first; what is not known until the end was silent."""
    found: list[Stretch] = []
    for row, next_ns in zip(rows, [*(row.heard_ns for row in rows[1:]), until_ns], strict=False):
        end_ns = next_ns if next_ns - row.heard_ns <= GAP_NS else row.heard_ns + GAP_NS // 4
        here = Stretch(row.heard_ns, end_ns, row.status, row.version, row.flags or "")
        if found and found[-1][2:] == here[2:]:
            found[-1] = found[-1]._replace(until_ns=end_ns)
        else:
            found.append(here)
        if end_ns < next_ns:
            found.append(Stretch(end_ns, next_ns, ""))
    return found


def band(parts: Sequence[Stretch], least_ns: int) -> list[Stretch]:
    """Stretches that can be told apart: neighbours shorter than `least_ns` are one, as the worst of them."""
    found: list[Stretch] = []
    for part in parts:
        if found and max(found[-1].length_ns, part.length_ns) < least_ns:
            worst = min(found[-1], part, key=lambda each: ORDER[each.state[1]])
            found[-1] = worst._replace(since_ns=found[-1].since_ns, until_ns=part.until_ns, is_mixed=True)
        else:
            found.append(part)
    return found


def way(rows: Sequence[TraceRow], parts: Sequence[Stretch], every_s: float = 10.0) -> list[Line]:
    """Where it drove, in the tones of the stretches, the worst on top; who stands adds nothing.

    every_s: longest time between two rows of a robot that is heard. Nothing joins rows farther apart than that and some lost reports, nor
    where it thought to be while it was lost and where it found itself.
    """
    found: list[Line] = []
    remaining, before_ns, was_lost = iter(parts), None, False
    part = next(remaining, None)
    for row in rows:
        if row.x_map_m is None or row.y_map_m is None:
            before_ns = None
            continue
        while part is not None and part.until_ns <= row.heard_ns:
            part = next(remaining, None)
        here, tone = (round(row.x_map_m, 2), round(row.y_map_m, 2)), "quiet" if part is None else part.state[1]
        is_lost = words_of(row.status)[1] == "bad"
        if before_ns is None or row.heard_ns - before_ns > 1.5e9 * every_s or (was_lost and not is_lost):
            found.append(Line([here], tone))
        elif tone != found[-1].tone:
            found.append(Line([found[-1].points[-1], here], tone))
        elif dist(found[-1].points[-1], here) >= _STEP_M:
            found[-1].points.append(here)
        before_ns, was_lost = row.heard_ns, is_lost
    return sorted((line for line in found if len(line.points) > 1), key=lambda line: -ORDER[line.tone])


def last_drive(rows: Sequence[TraceRow]) -> tuple[int, int] | None:
    """The last time in which it moved without a pause of ten minutes, and a minute around it; None where it never moved."""
    begin_ns = end_ns = None
    before: tuple[float, float] | None = None
    for row in rows:
        if row.x_map_m is None or row.y_map_m is None:
            continue
        here = (row.x_map_m, row.y_map_m)
        if before is None or dist(before, here) >= _STEP_M:
            if before is not None:
                begin_ns = row.heard_ns if end_ns is None or row.heard_ns - end_ns > _PAUSE_NS else begin_ns
                end_ns = row.heard_ns
            before = here
    return None if begin_ns is None or end_ns is None else (begin_ns - _AROUND_NS, end_ns + _AROUND_NS)


def curve(rows: Sequence[TraceRow], name: str, shown: tuple[int, int]) -> tuple[float, float, str] | None:
    """How a figure of the traces went, in means of equal parts of a range: lowest, highest, and the path of an SVG 1000 wide and 100 high.

    It begins at 0 and is broken where nothing was heard; None where the figure was never reported.
    """
    part_ns = max((shown[1] - shown[0]) // _COLUMNS, GAP_NS)
    parts: dict[int, list[float]] = defaultdict(list)
    for row in rows:
        if (value := getattr(row, name)) is not None:
            parts[(row.heard_ns - shown[0]) // part_ns].append(value)
    if not parts:
        return None
    means, width = {n: fmean(values) for n, values in parts.items()}, 1000 * part_ns / (shown[1] - shown[0])
    high = max(means.values())
    path = "".join(
        f"{'L' if n - 1 in means else 'M'}{n * width:.1f} {100 - 90 * mean / (high or 1):.0f}h{width:.1f}"
        for n, mean in means.items()
    )
    return min(means.values()), high, path


def page(services: Services, context: PageContext, robot: str) -> dict[str, object]:
    """What the template needs. UsageError for an unknown robot."""
    live = services.robots.robot(context.site, robot)
    if live is None:
        raise UsageError(f"site {context.site} never heard of a robot {robot[:40]!r}; the page Robots lists them")
    (since_ns, end_ns), now_ns, ingest = context.time_range(), time.time_ns(), services.settings.config.ingest
    until_ns = min(now_ns, end_ns or now_ns)
    kept_ns = until_ns - max(_USUAL_NS, round(ingest.trace_days * _USUAL_NS))
    hours = {"since_hour": hour_of(min(since_ns or kept_ns, until_ns - 1)), "until_hour": hour_of(until_ns - 1) + 1}
    traced = services.maps.store.fleet.trace(context.site, robot, **hours)
    rows = sorted((row for row in traced if row.heard_ns < until_ns), key=lambda row: row.heard_ns)
    drive = last_drive(rows) if (since_ns, end_ns) == EVER else None
    if drive is not None:
        since_ns, until_ns = drive[0], min(drive[1], now_ns)
    since_ns = until_ns - _USUAL_NS if since_ns is None else min(since_ns, until_ns - 1)
    span_ns = until_ns - since_ns
    rows = [row for row in rows if since_ns <= row.heard_ns < until_ns]
    parts = stretches(rows, until_ns)
    shown = band(parts, span_ns // _BAND_PARTS)
    wanted = FailureFilter(site=context.site, robot=robot, until_ns=end_ns)
    failures = services.maps.store.fleet.failures(wanted, limit=FAILURES_SHOWN)
    within = [row for row in failures if since_ns <= row.happened_ns < until_ns]
    curves = [(words, form, curve(rows, name, (since_ns, until_ns))) for words, name, form in _CURVES]
    enrolled = services.maps.store.log(site=context.site, kind="robot enrolled")
    version = live.status.version or services.maps.current_version(context.site)
    trail = way(rows, shown, ingest.trace_every_s)
    layers = [
        Layer("Way", trail),
        Layer("Failures", failure_marks(context, within)),
        Layer("Robots", live.marks()),
        Layer("Chosen place"),
    ]
    places = [place for line in trail for place in line.points] + ([] if live.place_m is None else [live.place_m])
    return {
        "usual": "Last drive" if drive else "Last 24 h",
        "robot": robot,
        "now": now(services, context, robot),
        "scene": scene_of(services, context, version, layers, places_m=places),
        "version": version,
        "at": lambda ns: round(100 * (ns - since_ns) / span_ns, 3),
        "ticks": [since_ns + n * span_ns // (_TICKS - 1) for n in range(_TICKS)],
        "is_day": span_ns <= 1.5 * _USUAL_NS,
        "parts": parts,
        "band": shown,
        "curves": [(words, form, *found) for words, form, found in curves if found],
        "failures": failures,
        "pictures": services.maps.store.fleet.first_pictures(row.number for row in failures),
        "within": within,
        "tone_of": tone_of,
        "cameras": [(PARAMETERS[figure.name], figure.words) for figure in live.calibration],
        "enrolled": next((line for line in enrolled if line.detail == robot), None),
        "drifts": [PARAMETERS[figure.name] for figure in live.calibration if figure.is_drifted],
    }


def now(services: Services, context: PageContext, robot: str) -> dict[str, object]:
    """What changes from second to second."""
    live = services.robots.robot(context.site, robot)
    if live is None:
        return {"line": Sentence("quiet", "It is not known any more."), "facts": [], "marks": [], "incident": None}
    where = live.where(services.maps.store.areas(context.site), services.maps.levels(context.site))
    state, (since, exact) = live.words.capitalize(), since_words(context, live)
    if live.tone == "quiet":
        state += f", last heard {since} ago"
    elif since:
        state += f" for {since}"
    is_offline = live.tone == "quiet"
    why = "" if is_offline else ", ".join(remarks(live))
    words = f"{': '.join(filter(None, [', '.join(filter(None, [state, where])), why]))}."
    told = [live.words] if is_offline else [*live.flags, live.words]
    advice = next((_ADVICE[name] for name in told if name in _ADVICE), "")
    line = Sentence(live.tone, words, exact and f"since {exact}", advice)
    _, alerts = alerts_of(services, services.health.site(context.site))
    return {"line": line, "facts": _facts(live), "marks": live.marks(), "incident": alerts.get(robot)}


def _facts(robot: LiveRobot) -> list[tuple[str, str]]:
    """What it says of itself, as far as it does."""
    version, clock_s = str(robot.status.version or "none"), robot.status.clock_ahead_s
    found = [
        ("Map version", f"{version}, should be {robot.status.wanted_version}" if robot.is_behind else version),
        ("Refuses a version", robot.refused),
        ("Tries a new version", "yes" if robot.status.is_canary else ""),
        *(
            (words, form.format(value))
            for words, name, form in _FIGURES
            if isinstance(value := robot.metrics.get(name), int | float)
        ),
        ("Cameras", str(robot.metrics.get("views") or "")),
        ("Clock against the server's", "" if clock_s is None else f"{clock_s:+z.2f} s"),
    ]
    return [(words, value) for words, value in found if value]
