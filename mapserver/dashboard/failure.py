"""The page of one failure: why, and is it one or many? Its answer in a sentence, what the camera saw beside what the map expected, the
seconds around it to step through and on the map, what else failed there, and the robot's whole report.

Robots choose the stamps and places that they send: what lies far from the failure is left out.
"""

from collections.abc import Sequence
from datetime import tzinfo
from itertools import groupby, pairwise
from math import dist
from typing import NamedTuple

from fleetmap.failure_definition import is_blind, is_usable
from fleetmap.failure_summary import Moment
from fleetmap.messages import Cause, FailureReport, Status
from mapserver.api.moments import clock_text
from mapserver.dashboard.console import PageContext, Services, number, scene_of
from mapserver.dashboard.failures import ADVICE, failure_marks, held, tone_of
from mapserver.dashboard.fleet_health import MANY_FAILURES, NEAR_NS, places_of
from mapserver.dashboard.live import words_of
from mapserver.dashboard.map_layers import Layer, Line, Mark, Square
from mapserver.store import FailureDetail, FailureFilter, FailureRow, PictureRow

_NEAR_M = 5.0
_LISTED = 6
_SILENT_S = 2.0  # what was between is not known
_JUMP_M, _JUMP_MPS = 0.3, 3.0  # beyond both an estimate was corrected: no robot drives so
_FARTHEST_M = 1e5


class FailureClock(NamedTuple):
    """The robot's stamps by the clock of whoever looks. began_ns: the failure's beginning by the robot, happened_ns: by the server."""

    began_ns: int
    happened_ns: int
    zone: tzinfo | None

    def at(self, stamp_ns: int) -> str:
        """The time of day, to a tenth of a second."""
        return clock_text(self.happened_ns + stamp_ns - self.began_ns, self.zone)

    def since(self, stamp_ns: int) -> str:
        """How long before or after the beginning."""
        off_s = (stamp_ns - self.began_ns) * 1e-9
        return f"{abs(off_s):.1f} s {'after' if off_s >= 0 else 'before'} the beginning"


class BlindTime(NamedTuple):
    """When a robot had no position to rely upon. blind_s: all of it, in so many parts.

    before_ns: the last moment before, found_ns: the first one with such a position behind; None where the recording does not have them.
    """

    since_ns: int
    until_ns: int
    blind_s: float
    parts: int
    before_ns: int | None
    found_ns: int | None


def pictures_near(pictures: Sequence[PictureRow], began_ns: int) -> list[PictureRow]:
    """The pictures of the recording within a minute of the beginning, the oldest first."""
    near = [each for each in pictures if each.kind == "replay" and abs(each.stamp_ns - began_ns) <= NEAR_NS]
    return sorted(near, key=lambda each: each.stamp_ns)


def blind_time(moments: Sequence[Moment], began_ns: int) -> BlindTime | None:
    """The parts without a position to rely upon that end at or after the beginning, as one; None where there are none."""
    without = [m.status == Status.INITIALISING or is_blind(m.status, _radius_m(m)) for m in moments]
    parts, first = [], 0
    for is_without, group in groupby(without):
        end = first + len(list(group))
        if is_without and moments[end - 1].stamp_ns >= began_ns:
            parts.append((first, end))
        first = end
    if not parts:
        return None
    last = len(moments) - 1
    times = [(moments[first].stamp_ns, moments[min(end, last)].stamp_ns) for first, end in parts]
    begin, end = parts[0][0], parts[-1][1]
    is_found = end <= last and is_usable(moments[end].status, _radius_m(moments[end]))
    return BlindTime(
        since_ns=times[0][0],
        until_ns=times[-1][1],
        blind_s=sum(until_ns - since_ns for since_ns, until_ns in times) * 1e-9,
        parts=len(parts),
        before_ns=moments[begin - 1].stamp_ns if begin else None,
        found_ns=moments[end].stamp_ns if is_found else None,
    )


def _radius_m(moment: Moment) -> float:
    return float("inf") if moment.radius_95_m is None else moment.radius_95_m


def answer(detail: FailureDetail, moments: Sequence[Moment], clock: FailureClock) -> str:
    """What happened, as one sentence's end: by the recording where it shows it, else by the report alone."""
    row, report = detail.failure, detail.report
    cause = row.cause.replace("_", " ") or "no cause known"
    wrong_m = report.wrong_by_m
    off = "" if wrong_m is None else f"; its later fixes put it {wrong_m:.1f} m from where it believed to be"
    blind = blind_time(moments, report.stamp_ns)
    if blind is None:
        return f"{cause}, {words_of(row.status)[0]} for {row.duration_s:.1f} s when it reported{off}"
    ends = f"not found again until the recording ends at {clock.at(blind.until_ns)}"
    if blind.found_ns is not None:
        ends = f"found again after {(blind.found_ns - report.stamp_ns) * 1e-9:.1f} s"
    # The images of a robot that is carried end with the last frame before; where it was put down shows when it is found.
    seen_ns = max((each.stamp_ns for each in moments if each.stamp_ns < report.stamp_ns), default=None)
    if row.cause == Cause.CARRIED and wrong_m is not None and seen_ns is not None:
        until = f"between {clock.at(seen_ns)} and {clock.at(blind.found_ns)}" if blind.found_ns is not None else ""
        return f"carried {wrong_m:.1f} m, by its own fixes, {until or f'after {clock.at(seen_ns)}'}, {ends}"
    since = f"from {clock.at(blind.since_ns)} until {clock.at(blind.until_ns)}"
    if blind.parts > 1:
        since = f"for {blind.blind_s:.1f} s in {blind.parts} parts {since}"
    elif blind.before_ns is None:
        since = f"since before {clock.at(blind.since_ns)}"
    return f"{cause}, no position to rely upon {since}, {ends}{off}"


def first_looks(moments: Sequence[Moment], began_ns: int) -> dict[str, int]:
    """Moments to look at first, in ms after the first: a second before the beginning, at it, and where the robot was found again."""
    if not moments:
        return {}
    blind = blind_time(moments, began_ns)
    found_ns = None if blind is None else blind.found_ns
    wanted = {"A second before": began_ns - 10**9, "As it began": began_ns, "Found again": found_ns}
    return {
        name: _after_ms(moments, min((each.stamp_ns for each in moments), key=lambda ns: abs(ns - stamp_ns)))
        for name, stamp_ns in wanted.items()
        if stamp_ns is not None
    }


def instants(moments: Sequence[Moment], pictures: Sequence[PictureRow], clock: FailureClock) -> list[dict[str, object]]:
    """All moments as the page shows them; pictures: the oldest first.

    at_ms: since the first; x, y, heading_rad: None without a pose; picture: number of the last one until then, -1 for none. Where the robot
    was silent, a further one says so.
    """
    found: list[dict[str, object]] = []
    picture = -1
    for each, next_ns in zip(moments, [*(later.stamp_ns for later in moments[1:]), 0], strict=False):
        while picture + 1 < len(pictures) and pictures[picture + 1].stamp_ns <= each.stamp_ns:
            picture += 1
        status, tone = words_of(each.status)
        words = ", ".join(filter(None, (status, each.cause.replace("_", " "))))
        x, y = _place(each) or (None, None)
        belief = "no position" if x is None else f"at {x:.2f}, {y:.2f} m"
        belief += "" if each.radius_95_m is None else f", within {each.radius_95_m:.2f} m with 95 %"
        place = {"x": x, "y": y, "heading_rad": each.heading_rad, "belief": belief}
        at_ms = _after_ms(moments, each.stamp_ns)
        times = {"at_ms": at_ms, "clock": clock.at(each.stamp_ns), "since": clock.since(each.stamp_ns)}
        found.append({**times, "words": words, "tone": tone, "picture": picture, **place})
        if next_ns - each.stamp_ns > _SILENT_S * 1e9:
            silent = {"words": "nothing recorded", "tone": "quiet", "x": None, "y": None, "belief": ""}
            found.append(found[-1] | silent | {"at_ms": at_ms + 100})
    return found


def _after_ms(moments: Sequence[Moment], stamp_ns: int) -> int:
    """How long after the first moment."""
    return (stamp_ns - moments[0].stamp_ns) // 10**6


def _place(moment: Moment) -> tuple[float, float] | None:
    position_m = moment.position_map_m
    if position_m is None or max(abs(value) for value in position_m) > _FARTHEST_M:
        return None
    return round(position_m[0], 3), round(position_m[1], 3)


def believed_path(moments: Sequence[Moment], clock: FailureClock) -> list[Line]:
    """Where the robot believed to be, in the colour of its state; where an estimate was corrected, a thin line says by how much."""
    found: list[Line] = []
    for last, each in pairwise(moments):
        there, here = _place(last), _place(each)
        if there is None or here is None:
            continue
        step_m, step_s = dist(here, there), (each.stamp_ns - last.stamp_ns) * 1e-9
        if step_s > _SILENT_S:
            continue
        if step_m > max(_JUMP_M, _JUMP_MPS * step_s):
            words = f"its position was corrected by {step_m:.1f} m at {clock.at(each.stamp_ns)}"
            found.append(Line([there, here], "quiet", words, 1.2))
            continue
        words, tone = words_of(each.status)
        if found and found[-1].words == words and found[-1].points[-1] == there:
            found[-1].points.append(here)
        else:
            found.append(Line([there, here], tone, words, 3.5))
    return found


def page(services: Services, context: PageContext, failure: str) -> dict[str, object]:
    """What the template needs."""
    detail = services.maps.store.fleet.failure(number(failure, "failure") or 0)
    row, report, began_ns = detail.failure, detail.report, detail.report.stamp_ns
    context = context._replace(site=row.site)  # whatever site the address names, or none
    moments = services.health.moments(row.number, began_ns)
    clock = FailureClock(began_ns, row.happened_ns, context.zone)
    recorded = pictures_near(detail.pictures, began_ns)
    seen = recorded or [picture for picture in detail.pictures if picture.kind == "frame"]
    pictures = [(picture.place, clock.at(picture.stamp_ns)) for picture in recorded]
    near, words = _nearby(services, row)
    return {
        "context": context,
        "site": row.site,
        "row": row,
        "report": report,
        "tone": tone_of(row),
        "answer": answer(detail, moments, clock),
        "answers": services.shown("answer", context, row, report),
        "advice": ADVICE.get(row.cause),
        "seen": min(seen, key=lambda picture: abs(picture.stamp_ns - began_ns), default=None),
        "clock": clock,
        "views": services.shown("failure", context, row, report),
        "seconds": {"instants": instants(moments, recorded, clock), "pictures": pictures},
        "steps": first_looks(moments, began_ns),
        "scene": _scene(services, context, row, report, believed_path(moments, clock)),
        "nearby": near[:_LISTED],
        "held": (incidents := held(services, [row, *near[:_LISTED]])),
        "incident": incidents[str(row.number)],
        "nearby_words": words,
        "nearby_pictures": services.maps.store.fleet.first_pictures(other.number for other in near[:_LISTED]),
        "facts": _facts(context, row, report),
        "links": [] if row.x_map_m is None else services.shown("place", context, row.version, row.x_map_m, row.y_map_m),
        "words_of": words_of,
        "matches": [picture.place for picture in detail.pictures if picture.kind == "matches"],
    }


def _scene(
    services: Services, context: PageContext, row: FailureRow, report: FailureReport, way: Sequence[Line]
) -> dict[str, object] | None:
    """The map around it: what the robot believed in these seconds, its fixes, and what parts add. None where the version is gone."""
    found = [
        Mark(fix.position_map_m[0], fix.position_map_m[1], "accent", "circle", f"fix, {fix.refused or 'used'}")
        for fix in report.fixes
        if fix.position_map_m is not None
    ]
    found += failure_marks(context, [row])
    added = [layer for layers in services.shown("failure_map", context, row, report) for layer in layers]
    layers = [*added, Layer("Path", way), Layer("Failure", found), Layer("Chosen moment")]
    marks = [*found, *(item for layer in added for item in layer.items)]
    places_m = [mark.box[:2] if isinstance(mark, Square) else (mark.x, mark.y) for mark in marks]
    places_m += [place for line in way for place in line.points]
    version = row.version or services.maps.current_version(context.site)
    return scene_of(services, context, version, layers, places_m=places_m)


def _nearby(services: Services, row: FailureRow) -> tuple[list[FailureRow], str]:
    """Others that began within _NEAR_M, the last first; and whether it is this robot or this place, as far as counts can tell."""
    kept = services.maps.store.fleet.failures(FailureFilter(site=row.site), limit=MANY_FAILURES)
    others = [other for other in kept if other.number != row.number]
    near = [other for other in others if len(both := places_of([row, other])) == 2 and dist(*both) <= _NEAR_M]
    elsewhere = sum(other.robot == row.robot for other in others) - sum(other.robot == row.robot for other in near)
    often = {0: "never failed", 1: "failed once"}.get(elsewhere, f"failed {elsewhere} times")
    own = f"{row.robot} {often} elsewhere"
    if row.x_map_m is None:
        return [], f"It claimed no position: what else failed there is not known. {own}."
    if not near:
        return [], f"No other failure that is kept began within {_NEAR_M:.0f} m of it; {own}."
    same, robots = sum(other.cause == row.cause for other in near), {other.robot for other in near} - {row.robot}
    told = (
        f"{len(near)} other{'s' * (len(near) > 1)} began within {_NEAR_M:.0f} m of it, {same or 'none'} with this cause"
    )
    return near, f"{told}, of {len(robots)} other robot{'s' * (len(robots) != 1)}; {own}."


def _facts(context: PageContext, row: FailureRow, report: FailureReport) -> list[tuple[str, str]]:
    """What the robot reported in figures, as far as it did."""

    def figure(value: float | None, unit: str = "") -> str:
        if value is None:
            return ""
        return f"{value:.0f}{unit}" if abs(value) >= 100 else f"{value:.3g}{unit}"

    landmarks = ""
    if report.landmarks_expected is not None and report.landmarks_seen is not None:
        landmarks = f"{report.landmarks_expected} expected, {report.landmarks_seen} seen"
    found = [
        ("Began", context.moment(row.happened_ns)),
        ("Received", context.moment(row.received_ns)),
        ("Duration when reported", f"{row.duration_s:.1f} s"),
        ("State of the robot", words_of(row.status)[0]),
        ("Tile", row.tile),
        ("Believed uncertainty when it began (95 % radius)", figure(report.radius_95_m, " m")),
        ("Believed position was wrong by", figure(report.wrong_by_m, " m")),
        ("Landmarks expected and seen", landmarks),
        ("Last fix against prediction (squared Mahalanobis distance)", figure(report.innovation)),
        ("Matches in the last fix", figure(report.inliers)),
        ("Brightness of the image (0 to 1)", figure(report.exposure)),
        ("Sharpness (1 is usual)", figure(report.sharpness)),
        ("Calibration", report.calibration),
        ("View of the rig (0 is the first)", "" if report.view is None else str(report.view)),
    ]
    return [(name, value) for name, value in found if value]
