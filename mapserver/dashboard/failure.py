"""The page of one failure: why, and is it one or many? Its answer in a sentence, what the camera saw beside what the map expected, the
seconds around it to step through, what else failed there, and the robot's whole report.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import hypot

from fleetmap.messages import FailureReport
from mapserver.dashboard import failure_story as story
from mapserver.dashboard.console import PageContext, Services, number, scene_of
from mapserver.dashboard.failures import ADVICE, failure_marks, tone_of
from mapserver.dashboard.fleet_health import MANY_FAILURES
from mapserver.dashboard.live import words_of
from mapserver.dashboard.map_layers import Layer, Line, Mark
from mapserver.store import FailureFilter, FailureRow

_NEAR_M = 5.0
_LISTED = 6


def page(services: Services, context: PageContext, failure: str) -> dict[str, object]:
    """What the template needs."""
    detail = services.maps.store.fleet.failure(number(failure, "failure") or 0)
    row, report, began_ns = detail.failure, detail.report, detail.report.stamp_ns
    context = replace(context, site=row.site)  # whatever site the address names, or none
    moments = story.moments_near(services.health.replay(row.number), began_ns)
    clock = story.FailureClock(began_ns, row.happened_ns, context.zone)
    recorded = story.pictures_near(detail.pictures, began_ns)
    seen = recorded or [picture for picture in detail.pictures if picture.kind == "frame"]
    pictures = [(picture.place, clock.at(picture.stamp_ns)) for picture in recorded]
    near, words = _nearby(services, row)
    return {
        "context": context,
        "site": row.site,
        "row": row,
        "report": report,
        "tone": tone_of(row),
        "answer": story.answer(detail, moments, clock),
        "advice": ADVICE.get(row.cause),
        "seen": min(seen, key=lambda picture: abs(picture.stamp_ns - began_ns), default=None),
        "clock": clock,
        "views": services.shown("failure", context, row, report),
        "seconds": {"instants": story.instants(moments, recorded, clock), "pictures": pictures},
        "steps": story.steps(moments, began_ns),
        "scene": _scene(services, context, row, report, story.path(moments, clock)),
        "nearby": near[:_LISTED],
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
    """The map around it: what the robot believed in these seconds, and its fixes. None where the version is gone."""
    version = row.version or services.maps.current_version(context.site)
    if version is None or not services.maps.has_version(context.site, version):
        return None
    found = [
        Mark(fix.position_map_m[0], fix.position_map_m[1], "accent", "circle", f"fix, {fix.refused or 'used'}")
        for fix in report.fixes
        if fix.position_map_m is not None
    ]
    found += failure_marks(context, [row])
    layers = [Layer("Path", way), Layer("Failure", found), Layer("Chosen moment")]
    places_m = [(mark.x, mark.y) for mark in found] + [place for line in way for place in line.points]
    return scene_of(services, context, version, layers, places_m=places_m)


def _nearby(services: Services, row: FailureRow) -> tuple[list[FailureRow], str]:
    """Others that began within _NEAR_M, the last first; and whether it is this robot or this place, as far as counts can tell."""
    kept = services.maps.store.fleet.failures(FailureFilter(site=row.site), limit=MANY_FAILURES)
    others = [other for other in kept if other.number != row.number]
    near = [other for other in others if _is_near(row, other)]
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


def _is_near(row: FailureRow, other: FailureRow) -> bool:
    if row.x_map_m is None or row.y_map_m is None or other.x_map_m is None or other.y_map_m is None:
        return False
    return hypot(other.x_map_m - row.x_map_m, other.y_map_m - row.y_map_m) <= _NEAR_M


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
