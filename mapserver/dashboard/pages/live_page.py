"""The live page: a survey while it drives, its path, landmarks and revisits, and whether tracking and mapping keep up."""

import numpy as np
from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.geometry import Array
from fleetmap.live_survey import COVERAGE_CELL_M
from mapserver.dashboard.fleet_parts import Figure
from mapserver.dashboard.layout import RESPONSE_TIMEOUT_S, PageContext, Services, html, notice, show
from mapserver.dashboard.map_layers import Dots, Layer, Line, Mark, Square, trail
from mapserver.dashboard.markup import badge, facts, joined, link, table
from mapserver.dashboard.rendering import TEMPLATES
from mapserver.dashboard.site_map import SiteMap
from mapserver.serving.live_surveys import LiveSurvey

_REFRESH_S = 0.5
_MARGIN_M = 4.0
_SHOWN_LANDMARKS = 4000
_BEYOND_M = 12.0  # landmarks of far walls would shrink everything else
_PHASES = {
    "tracking": ("warn", "The survey drives."),
    "adjusting": ("warn", "The drive is over; the finished map is made."),
    "stored": ("good", "The finished map is stored as a draft."),
    "failed": ("bad", "No map could be made of it."),
}


def install(services: Services) -> None:
    """Adds the page."""

    @ui.page("/live", title="Live – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def live_page(request: Request, site: str | None = None) -> None:
        async def build(context: PageContext) -> None:
            html(Markup("<h1>Survey of {}</h1>").format(context.site))
            shown = services.surveys.of(context.site)
            before = html(_before(context, shown))
            place = ui.element("div")
            drawn: SiteMap | None = None
            after = html(_after(shown))

            def draw(survey: LiveSurvey | None) -> None:
                nonlocal drawn
                if survey is None or not survey.state.path_m:
                    return
                if drawn is None:
                    with place:
                        drawn = _map(survey)
                    return
                for layer in _layers(survey):
                    drawn.show(layer.name, layer.items)

            draw(shown)

            def refresh() -> None:
                nonlocal shown
                found = services.surveys.of(context.site)
                is_new = found is not None and (shown is None or found.state is not shown.state)
                if is_new or (found is not None and shown is not None and found.is_silent != shown.is_silent):
                    before.set_content(str(_before(context, found)))
                    draw(found)
                    after.set_content(str(_after(found)))
                shown = found

            ui.timer(_REFRESH_S, refresh, immediate=False)

        await show(services, request, "live", site, build)


def _before(context: PageContext, survey: LiveSurvey | None) -> Markup:
    """What stands above the map."""
    if survey is None:
        return Markup(
            '<p class="quiet">No survey of this site was heard since the server started. '
            "<code>mapserver live RECORDING --site {} --store DIR --server ENDPOINT</code> shows one here.</p>"
        ).format(context.site)
    nothing = Markup("") if survey.state.path_m else Markup('<p class="quiet">No keyframe is mapped yet.</p>')
    return joined([_phase(context, survey), _scale(survey), _figures(survey), _parts(survey), nothing])


def _after(survey: LiveSurvey | None) -> Markup:
    """What stands below the map."""
    if survey is None:
        return Markup("")
    return joined([_estimate(survey), _missing(survey), _revisits(survey), _refused(survey)])


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
    return Markup(
        TEMPLATES.get_template("fleet_parts.html").module.figures(  # type: ignore[attr-defined]
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
    )


def _where(survey: LiveSurvey) -> Figure:
    """Status and accuracy of the newest keyframe."""
    estimate = survey.state.estimate
    if estimate is None:
        return Figure("Localization", "–", "in this map")
    return Figure("Localization", estimate.status, f"in this map, {_sigma(survey) or 'place unknown'}")


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


def _layers(survey: LiveSurvey) -> list[Layer]:
    """Landmarks, revisits and the path, coloured by how well it was tracked."""
    state = survey.state
    way, marks = state.path(), state.landmarks()
    if len(way):
        low, high = way[:, :2].min(axis=0) - _BEYOND_M, way[:, :2].max(axis=0) + _BEYOND_M
        marks = marks[((marks > low) & (marks < high)).all(axis=1)][:: max(1, len(marks) // _SHOWN_LANDMARKS)]
    return [
        Layer("Covered", _covered(state.covered())),
        Layer("Landmarks", [Dots(np.round(marks, 2).ravel().tolist())] if len(marks) else []),
        Layer(
            "Revisits", [Line([(a, b), (c, d)], "accent", "revisit", 1) for a, b, c, d in state.loop_lines().tolist()]
        ),
        Layer("Way", [*_part_trails(way, survey), *trail(way)]),
        Layer("Now", _now(survey, way)),
    ]


def _covered(cells: Array) -> list[Square]:
    """Squares with landmarks, the fuller the darker."""
    size, most = COVERAGE_CELL_M, max(1.0, float(cells[:, 2].max(initial=1.0)))
    return [
        Square((x * size, y * size, (x + 1) * size, (y + 1) * size), "tile", f"{n:.0f} landmarks", round(n / most, 3))
        for x, y, n in cells.tolist()
    ]


def _now(survey: LiveSurvey, way: Array) -> list[Mark]:
    """The newest keyframe, and where directions are missing."""
    lacking = [
        Mark(
            m.x_m, m.y_m, "warn", "triangle", f"nothing looks {m.heading}: {m.places} places were passed the other way"
        )
        for m in survey.state.missing
    ]
    if not len(way):
        return lacking
    tone = "good" if way[-1, 2] > 0 else "bad"
    return [*lacking, Mark(float(way[-1, 0]), float(way[-1, 1]), tone, "circle", "newest keyframe")]


def _part_trails(way: Array, survey: LiveSurvey) -> list[Line]:
    """A wide line below each part's path, in its colour, where there are several."""
    if len(survey.state.parts) < 2:
        return []
    numbers = survey.state.part_numbers()
    found = []
    for n in range(len(survey.state.parts)):
        places = way[numbers == n, :2]
        found += trail(np.column_stack([places, np.ones(len(places))]), 9, hue=_hue(n))
    return found


def _map(survey: LiveSurvey) -> SiteMap:
    way = survey.state.path()
    low, high = (way[:, :2].min(axis=0), way[:, :2].max(axis=0)) if len(way) else (np.zeros(2), np.zeros(2))
    box = (*(low - _MARGIN_M).tolist(), *(high + _MARGIN_M).tolist())
    shown = SiteMap(f"Survey of {survey.state.site} so far", box, _layers(survey), follows=True)
    html(
        Markup(
            '<p class="quiet">The way is green where tracking is good, yellow where half of the points disagree, red where it was lost. '
            "Thin lines are revisits. Squares are covered, the fuller the more landmarks they hold; triangles lack a direction. The "
            "finished map is adjusted anew.</p>"
        )
    )
    return shown


def _refused(survey: LiveSurvey) -> Markup:
    refused = survey.state.refused
    if not refused:
        return Markup("")
    named = facts([(verdict.replace("_", " "), count) for verdict, count in sorted(refused.items())])
    return Markup("<h2>Refused candidates for revisits</h2>{}").format(named)
