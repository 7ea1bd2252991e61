"""The live page: a survey while it drives, its path, landmarks and revisits, and whether tracking and mapping keep up."""

from typing import NamedTuple

import numpy as np
from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.geometry import Array
from fleetmap.live_survey import COVERAGE_CELL_M
from mapserver.dashboard import drawing, fleet_parts
from mapserver.dashboard.drawing import Line, Mark
from mapserver.dashboard.fleet_parts import Figure
from mapserver.dashboard.layout import RESPONSE_TIMEOUT_S, PageContext, Services, html, notice, show
from mapserver.dashboard.markup import badge, facts, joined, link, table
from mapserver.dashboard.plan import Plan
from mapserver.serving.live_surveys import LiveSurvey

_REFRESH_S = 0.5
_MARGIN_M = 4.0
_SHOWN_LANDMARKS = 4000
_BEYOND_M = 12.0  # landmarks of far walls would shrink everything else
_PHASES = {
    "tracking": ("warn", "The survey drives."),
    "adjusting": ("warn", "The drive is over; the finished map is made."),
    "stored": ("good", "The finished map is stored as a draft."),
    "localized": ("good", "The drive is over; nothing was mapped."),
    "failed": ("bad", "No map could be made of it."),
}


def install(services: Services) -> None:
    """Adds the page."""

    @ui.page("/live", title="Live – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def live_page(request: Request, site: str | None = None) -> None:
        async def build(context: PageContext) -> None:
            html(Markup("<h1>Survey of {}</h1>").format(context.site))
            shown = services.surveys.of(context.site)
            content = html(_content(context, shown))

            def refresh() -> None:
                nonlocal shown
                found = services.surveys.of(context.site)
                is_new = found is not None and (shown is None or found.state is not shown.state)
                if is_new or (found is not None and shown is not None and found.is_silent != shown.is_silent):
                    content.set_content(str(_content(context, found)))
                shown = found

            ui.timer(_REFRESH_S, refresh, immediate=False)

        await show(services, request, "live", site, build)


def _content(context: PageContext, survey: LiveSurvey | None) -> Markup:
    if survey is None:
        return Markup(
            '<p class="quiet">No survey of this site was heard since the server started. '
            "<code>mapserver live RECORDING --site {} --store DIR --server ENDPOINT</code> shows one here.</p>"
        ).format(context.site)
    found = [_phase(context, survey), _scale(survey), _figures(survey), _parts(survey), _picture(survey)]
    return joined([*found, _estimate(survey), _missing(survey), _revisits(survey), _refused(survey), _findings(survey)])


def _phase(context: PageContext, survey: LiveSurvey) -> Markup:
    state = survey.state
    if survey.is_silent:
        return notice("bad", f"Nothing was heard of it for {survey.seconds_since:.0f} s; look at the survey robot.")
    tone, words = _PHASES.get(state.phase, ("warn", state.phase))
    more = Markup(" {}").format(state.words) if state.words else Markup("")
    if state.phase == "stored" and state.version is not None:
        more = Markup(" {}").format(link(context.to("map", version=state.version), f"Version {state.version}"))
    return notice(tone, Markup("{}{}").format(words, more))


def _figures(survey: LiveSurvey) -> Markup:
    state = survey.state
    way = state.path()
    way_m = float(np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1).sum()) if len(way) > 1 else 0.0
    answered = "as fast as it goes" if state.latency_ms is None else f"{state.latency_ms:.0f} ms"
    late = f"{state.late_frames} of {state.frames} frames later than the next one"
    covered = state.covered()
    return fleet_parts.figures(
        [
            Figure("Recorded", f"{state.seconds:.0f} s", f"{state.frames} frames, {way_m:.0f} m"),
            Figure("Frames answered within", answered, late),
            Figure("Keyframes", str(state.keyframes), f"{state.behind} wait to be mapped"),
            _where(survey),
            Figure(
                "Covered",
                f"{len(covered) * COVERAGE_CELL_M**2:.0f} m²",
                f"squares of {COVERAGE_CELL_M:g} m with landmarks",
            ),
            Figure("Revisits", str(state.loops), f"{sum(state.refused.values())} candidates refused"),
        ]
    )


def _where(survey: LiveSurvey) -> Figure:
    """Status and accuracy of the newest keyframe."""
    estimate = survey.state.estimate
    inside = "this map" if survey.state.frozen is None else f"version {survey.state.frozen}"
    if estimate is None:
        return Figure("Localization", "–", f"in {inside}")
    return Figure("Localization", estimate.status, f"in {inside}, {_sigma(survey) or 'place unknown'}")


def _sigma(survey: LiveSurvey) -> str:
    """Standard deviations of position and heading in words; empty where none is known."""
    estimate = survey.state.estimate
    if estimate is None or estimate.cov_rot_trans is None:
        return ""
    variances = np.diag(np.reshape(estimate.cov_rot_trans, (6, 6)))
    sigma = _units(survey)
    return f"σ {np.sqrt(variances[3:5].max()):.2f} {sigma}, {np.degrees(np.sqrt(variances[2])):.1f}°"


def _units(survey: LiveSurvey) -> str:
    return "m" if survey.state.scale_known else "units"


def _scale(survey: LiveSurvey) -> Markup:
    if survey.state.scale_known:
        return Markup("")
    words = (
        "The scale is not known: lengths of a map from one camera that is still being made are in a unit of its own. With an IMU "
        "the draft at the end has metres, if the robot speeded up, slowed down and turned enough."
    )
    return notice("warn", words)


def _estimate(survey: LiveSurvey) -> Markup:
    estimate = survey.state.estimate
    if estimate is None or estimate.map_from_odom is None:
        return Markup("")
    placed = estimate.map_from_odom.target_from_source @ estimate.odom_from_base.target_from_source
    heading_deg = np.degrees(np.arctan2(placed[1, 0], placed[0, 0]))
    where = f"{placed[0, 3]:.2f}, {placed[1, 3]:.2f}, {placed[2, 3]:.2f} {_units(survey)}"
    rows = [("status", estimate.status), ("cause", estimate.cause or "–"), ("position", where)]
    rows += [("heading", f"{heading_deg:.1f}°"), ("standard deviations", _sigma(survey) or "–")]
    return joined([Markup("<h2>Where the robot is</h2>"), facts(rows)])


def _missing(survey: LiveSurvey) -> Markup:
    missing = survey.state.missing
    if not missing:
        return Markup("")
    rows = [(f"{m.x_m:.0f}, {m.y_m:.0f}", m.heading, m.places) for m in missing]
    head = ("around x, y (m)", "nothing looks", "places that were passed the other way")
    words = "A robot that comes the other way finds nothing there. Drive these again, looking that way (E along x, N along y)."
    title = Markup("<h2>Directions that are missing</h2><p>{}</p>").format(words)
    return joined([title, table(head, rows, empty="", name="Missing directions")])


def _revisits(survey: LiveSurvey) -> Markup:
    tones = {"accepted": "good", "ambiguous": "warn"}
    rows = [
        (
            f"{r.at_s:.0f} s",
            f"{r.seen_s:.0f} s",
            badge(tones.get(r.verdict, "bad"), r.verdict.replace("_", " ")),
            r.matches,
            r.words,
        )
        for r in reversed(survey.state.revisits)
    ]
    if not rows:
        return Markup("")
    head = ("at", "looks like", "", "matches", "why")
    return joined([Markup("<h2>Newest revisits</h2>"), table(head, rows, empty="", name="Newest revisits")])


def _findings(survey: LiveSurvey) -> Markup:
    tones = {"ok": "good", "warn": "warn"}
    rows = [
        (f.name, badge(tones.get(f.verdict, "bad"), f.verdict), f.words, f"{f.at_s:.0f} s")
        for f in survey.state.findings
    ]
    if not rows:
        return Markup("")
    head = ("check", "", "found", "at")
    return joined(
        [Markup("<h2>The doctor, while it drives</h2>"), table(head, rows, empty="", name="Findings of the doctor")]
    )


def _parts(survey: LiveSurvey) -> Markup:
    """What lies to each other, where that is not everything."""
    parts = survey.state.parts
    if len(parts) < 2:
        return Markup("")
    words = (
        f"The survey lost itself: {len(parts)} parts lie apart, drawn where odometry guesses. Drive a metre through a place of the "
        "map, the same way round: three keyframes that agree join the parts. What stays apart is left out of the map."
    )
    rows = [
        (
            Markup('<span class="part" style="--hue:{}">{}</span>').format(_hue(number), number + 1),
            f"{part.start_s:.0f} to {part.end_s:.0f} s",
            part.keyframes,
            badge("good", "the map") if part.is_map else badge("bad", "not joined"),
        )
        for number, part in enumerate(parts)
    ]
    head = ("part", "of the recording", "keyframes", "")
    return joined([notice("bad", words), table(head, rows, empty="", name="Parts of the survey")])


def _hue(number: int) -> int:
    """Degrees, as different as can be from those of the parts before."""
    return round(250 + number * 137.5) % 360


def _part_trails(way: Array, survey: LiveSurvey, width_m: float) -> Markup:
    """A wide line below each part's path, in its colour, where there are several."""
    if len(survey.state.parts) < 2:
        return Markup("")
    numbers = survey.state.part_numbers()
    return joined(
        Markup('<g class="part" style="--hue:{}"><title>part {}</title>{}</g>').format(
            _hue(n),
            n + 1,
            drawing.trail(np.column_stack([way[numbers == n, :2], np.ones(np.sum(numbers == n))]), width_m),
        )
        for n in range(len(survey.state.parts))
    )


class _Square(NamedTuple):
    """A covered square, as `drawing.coverage` takes a tile."""

    x: int
    y: int
    landmarks: int


def _picture(survey: LiveSurvey) -> Markup:
    """Landmarks, revisits and the path, coloured by how well it was tracked."""
    state = survey.state
    way, marks, lines = state.path(), state.landmarks(), state.loop_lines()
    if not len(way):
        return Markup('<p class="quiet">No keyframe is mapped yet.</p>')
    low, high = way[:, :2].min(axis=0) - _BEYOND_M, way[:, :2].max(axis=0) + _BEYOND_M
    marks = marks[((marks > low) & (marks < high)).all(axis=1)][:: max(1, len(marks) // _SHOWN_LANDMARKS)]
    seen = np.concatenate([way[:, :2], marks])
    low, high = seen.min(axis=0) - _MARGIN_M, seen.max(axis=0) + _MARGIN_M
    tiles = tuple(_Square(int(x), int(y), int(n)) for x, y, n in state.covered().tolist())
    corners = (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))
    plan = Plan(*corners, COVERAGE_CELL_M, tiles, len(way), b"", ())
    size_m = max(plan.size_m) * 0.004
    loops = drawing.lines(Line((a, b), (c, d), "accent", "revisit") for a, b, c, d in lines.tolist())
    here = Mark(float(way[-1, 0]), float(way[-1, 1]), "good" if way[-1, 2] > 0 else "bad", "circle", "newest keyframe")
    lacking = [
        Mark(
            m.x_m, m.y_m, "warn", "triangle", f"nothing looks {m.heading}: {m.places} places were passed the other way"
        )
        for m in state.missing
    ]
    layers = [
        drawing.coverage(plan),
        drawing.dots(marks, size_m),
        loops,
        _part_trails(way, survey, 3.5 * size_m),
        drawing.trail(way, size_m),
        drawing.marks(plan, [*lacking, here]),
        drawing.scale_bar(plan),
    ]
    picture = drawing.svg(plan, f"Survey of {state.site} so far", layers)
    return Markup(
        '<div class="planbox">{}</div><p class="quiet">The way is green where tracking is good, yellow where half of the points disagree, '
        "red where it was lost. Thin lines are revisits. Squares are covered, the fuller the more landmarks they hold; triangles lack a "
        "direction. The finished map is adjusted anew.</p>"
    ).format(picture)


def _refused(survey: LiveSurvey) -> Markup:
    refused = survey.state.refused
    if not refused:
        return Markup("")
    named = facts([(verdict.replace("_", " "), count) for verdict, count in sorted(refused.items())])
    return Markup("<h2>Refused candidates for revisits</h2>{}").format(named)
