"""The page of a robot: what has it been doing? A band of its states, its way and its figures in a time; a stream tells what it is now."""

import time

from fleetmap.errors import UsageError
from mapserver.dashboard.console import PageContext, Services, scene_of
from mapserver.dashboard.failures import failure_marks, tone_of
from mapserver.dashboard.fleet_health import FAILURES_SHOWN
from mapserver.dashboard.live import LiveRobot
from mapserver.dashboard.map_layers import Layer
from mapserver.dashboard.rendering import age
from mapserver.dashboard.robot_history import band, curve, stretches, way
from mapserver.fleet_statistics.robot_calibration import PARAMETERS
from mapserver.store import FailureFilter

_USUAL_NS = 24 * 3_600_000_000_000
_TICKS, _BAND_PARTS = 5, 400
_FIGURES = (
    ("CPU of a frame, mean", "frame_ms_mean", "{:.1f} ms"),
    ("CPU of a frame, slowest of a hundred", "frame_ms_p99", "{:.1f} ms"),
    ("Frames that it is too slow for", "frames_dropped_share", "{:.0%}"),
    ("Brightness of the image (0 to 1)", "exposure", "{:.2f}"),
    ("Sharpness (1 is usual)", "sharpness", "{:.2f}"),
    ("Believed uncertainty (95 % radius)", "radius_95_m", "{:.2f} m"),
    ("Speed", "speed_mps", "{:.2f} m/s"),
    ("Failure reports that wait", "spool_waiting", "{:.0f}"),
)
_CURVES = (("CPU of a frame", "frame_ms", "{:.1f} ms"), *_FIGURES[3:5])  # and brightness and sharpness


def page(services: Services, context: PageContext, robot: str) -> dict[str, object]:
    """What the template needs. UsageError for an unknown robot."""
    found = services.robots.look(context.site).robot(robot)
    if found is None:
        raise UsageError(f"site {context.site} never heard of a robot {robot[:40]!r}; the page Robots lists them")
    return _page(services, context, found)


def now(services: Services, context: PageContext, robot: str) -> dict[str, object]:
    """What changes from second to second."""
    found = services.robots.look(context.site).robot(robot)
    if found is not None:
        return _now(services, context, found)
    return {"line": {"tone": "quiet", "words": "It is not known any more.", "exact": ""}, "facts": [], "marks": []}


def _page(services: Services, context: PageContext, robot: LiveRobot) -> dict[str, object]:
    (since_ns, end_ns), now_ns = context.time_range(), time.time_ns()
    until_ns = min(now_ns, end_ns or now_ns)
    since_ns = until_ns - _USUAL_NS if since_ns is None else min(since_ns, until_ns - 1)
    span_ns = until_ns - since_ns
    rows = sorted(services.health.trace(context.site, robot.name, since_ns, until_ns), key=lambda row: row.heard_ns)
    parts = stretches(rows, until_ns)
    shown = band(parts, span_ns // _BAND_PARTS)
    wanted = FailureFilter(site=context.site, robot=robot.name, until_ns=end_ns)
    failures = services.maps.store.fleet.failures(wanted, limit=FAILURES_SHOWN)
    within = [row for row in failures if row.happened_ns >= since_ns]
    curves = [(words, form, curve(rows, name, (since_ns, until_ns))) for words, name, form in _CURVES]
    version = robot.version or services.maps.current_version(context.site)
    drawn = None
    if version is not None and services.maps.has_version(context.site, version):
        trail = way(rows, shown, services.settings.ingest.trace_every_s)
        layers = [
            Layer("Way", trail),
            Layer("Failures", failure_marks(context, within)),
            Layer("Robots", robot.marks()),
        ]
        places = [place for line in trail for place in line.points] + ([] if robot.place_m is None else [robot.place_m])
        drawn = scene_of(services, context, version, [*layers, Layer("Chosen place")], places_m=places)
    return {
        "robot": robot.name,
        "now": _now(services, context, robot),
        "scene": drawn,
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
    }


def _now(services: Services, context: PageContext, robot: LiveRobot) -> dict[str, object]:
    where = robot.where(services.maps.store.areas(context.site))
    state, exact = robot.words.capitalize(), ""
    if robot.tone == "quiet":
        state += f", last heard {age(robot.seconds_since)} ago"
    elif robot.since_ns is not None:
        state += f" for {age(max(0.0, time.time() - robot.since_ns / 1e9))}"
        exact = f"since {context.moment(robot.since_ns)}"
    flags = f" It reports: {', '.join(robot.flags)}.".replace("_", " ") if robot.flags else ""
    words = f"{', '.join(filter(None, [state, where]))}.{flags}"
    return {
        "line": {"tone": robot.tone, "words": words, "exact": exact},
        "facts": _facts(robot),
        "marks": robot.marks(),
    }


def _facts(robot: LiveRobot) -> list[tuple[str, str]]:
    """What it says of itself, as far as it does."""
    version, clock_s = str(robot.version or "none"), robot.clock_ahead_s
    found = [
        ("Map version", f"{version}, should be {robot.wanted_version}" if robot.is_behind else version),
        ("Refuses a version", robot.refused),
        ("Tries a new version", "yes" if robot.is_canary else ""),
        *(
            (words, form.format(value))
            for words, name, form in _FIGURES
            if isinstance(value := robot.metrics.get(name), int | float)
        ),
        ("Cameras", str(robot.metrics.get("views") or "")),
        ("Clock against the server's", "" if clock_s is None else f"{clock_s:+.2f} s"),
        ("Cameras against the map", "; ".join(f"{PARAMETERS[f.name]} {f.words}" for f in robot.calibration)),
    ]
    return [(words, value) for words, value in found if value]
