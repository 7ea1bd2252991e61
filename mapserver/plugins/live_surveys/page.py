"""The live page: a survey while it drives, its path, landmarks and revisits, and whether tracking and mapping keep up."""

import threading
import time
from base64 import b64encode
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleetmap.errors import LinkError
from fleetmap.geometry import Array
from fleetmap.mapformat.names import check_name, is_name, sha256_hex
from fleetmap.messages import decode_message, split_key
from mapserver.dashboard.console import Page, PageContext, Services
from mapserver.dashboard.install import Host
from mapserver.dashboard.live import words_of
from mapserver.dashboard.map_layers import Dots, Layer, Line, Mark, Square, trail
from mapserver.dashboard.rendering import TEMPLATES
from mapserver.dashboard.survey_jobs import VERDICTS
from mapserver.plugins.live_surveys.message import COLUMNS, COVERAGE_CELL_M, LiveSurveyState, live_key

_FOLDER = Path(__file__).parent
_MARGIN_M = 4.0
_SHOWN_LANDMARKS = 4000
_BEYOND_M = 12.0  # landmarks of far walls would shrink everything else
_PHASES = {
    "tracking": ("", "The survey drives."),
    "adjusting": ("", "The drive is over; the finished map is made."),
    "stored": ("good", "The finished map is stored as a draft."),
    "failed": ("bad", "No map could be made of it."),
}
_MOST_SITES = 32
SILENT_S = 5.0  # surveys report twice a second during the drive


class LiveSurvey(NamedTuple):
    """A state, the time since it was received, and its hash."""

    state: LiveSurveyState
    seconds_since: float
    sha256: str

    @property
    def is_silent(self) -> bool:
        return self.state.phase == "tracking" and self.seconds_since > SILENT_S


class LiveSurveys:
    """Thread-safe; the latest sites, each with its newest state."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._states: dict[str, tuple[LiveSurveyState, float, str]] = {}
        self._lock = threading.Lock()

    def hear(self, key: str, payload: bytes) -> None:
        """Store a survey's state; LinkError for an invalid one, and for one of another site than its key."""
        site, _, _ = split_key(key)
        state = decode_message(payload, LiveSurveyState)
        if state.site != check_name(site, "site"):
            raise LinkError(f"a survey of {state.site[:64]!r} under the key of another site; check its sender")
        state.path(), state.part_numbers(), *map(state.rows, COLUMNS)
        with self._lock:
            self._states.pop(state.site, None)
            self._states[state.site] = state, self._clock_s(), sha256_hex(payload)
            if len(self._states) > _MOST_SITES:
                del self._states[next(iter(self._states))]

    def sites(self, asked: str | None = None) -> list[str]:
        """Return those with a survey, and the one that is asked for, whose survey may be the first thing heard of it."""
        with self._lock:
            return sorted({*self._states, *filter(is_name, [asked or ""])})

    def of(self, site: str) -> LiveSurvey | None:
        """Return the site's survey, None if none was received since the server's start."""
        with self._lock:
            found = self._states.get(site)
            return None if found is None else LiveSurvey(found[0], self._clock_s() - found[1], found[2])


def install(host: Host) -> None:
    """Add the page, and what it hears from surveys."""
    surveys, console = LiveSurveys(), host.console
    if host.hear is not None:
        host.hear(live_key("*"), "survey", surveys.hear)
    console.help["live"] = "how_to.md#watch-a-survey-while-it-drives"
    console.files("parts/live", _FOLDER / "static")
    template = TEMPLATES.from_string((_FOLDER / "live.html").read_text("utf-8"))
    link = "Live", "parts/live/icon.svg#live"
    console.page("live", Page(template, partial(page, surveys), link=link, under_way=surveys.sites))
    console.stream("live/now", partial(heard, surveys), under_way=surveys.sites)


def heard(surveys: LiveSurveys, _: Services, context: PageContext) -> dict[str, object]:
    """Changes when the page does."""
    survey = surveys.of(context.site)
    return {"heard": None} if survey is None else {"heard": survey.sha256, "silent": survey.is_silent}


def page(surveys: LiveSurveys, _: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    survey = surveys.of(context.site)
    if survey is None:
        return {"state": None}
    state = survey.state
    tone, words = _PHASES.get(state.phase, ("warn", state.phase))
    if survey.is_silent:
        tone = "bad"
        words = f"Nothing was heard of it for {survey.seconds_since:.0f} s; look at the survey robot."
    drafted = state.version if state.phase == "stored" else None
    way = state.path()[:, :2] if len(state.path()) else np.zeros((1, 2))
    return {
        "state": state,
        "tone": tone,
        "words": words if drafted is not None or not state.words else f"{words} {state.words}",
        "drafted": drafted,
        "draft": context.to("map", version=drafted),
        "figures": _figures(state),
        "picture": b64encode(state.picture).decode(),
        "scene": {
            "label": f"Survey of {state.site} so far",
            "box": [*(way.min(axis=0) - _MARGIN_M).tolist(), *(way.max(axis=0) + _MARGIN_M).tolist()],  # in sight first
            "layers": _layers(state),
            "follows": True,
        },
        "hues": [_hue(number) for number in range(len(state.parts))],
        "verdicts": VERDICTS,
    }


def _figures(state: LiveSurveyState) -> list[tuple[str, str, str]]:
    """Names, values and remarks."""
    way, covered = state.path(), state.rows("cells")
    way_m = float(np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1).sum()) if len(way) > 1 else 0.0
    answered = "as fast as it goes" if state.latency_ms is None else f"{state.latency_ms:.0f} ms"
    late = f"{state.late_frames} of {state.frames} frames later than the next one"
    area = f"{len(covered) * COVERAGE_CELL_M**2:.0f} m²"
    return [
        ("Recorded", f"{state.seconds:.0f} s", f"{state.frames} frames, {way_m:.0f} {_units(state)}"),
        ("Localization", *_placed(state)),
        ("Frames answered within", answered, late),
        ("Keyframes", str(state.keyframes), f"{state.behind} wait to be mapped"),
        ("Covered", area, f"squares of {COVERAGE_CELL_M:g} m with landmarks"),
        ("Revisits", str(state.loops), f"{sum(state.refused.values())} candidates refused"),
    ]


def _placed(state: LiveSurveyState) -> tuple[str, str]:
    """Status of the newest keyframe; where it is in this map and how exactly, as far as that is known."""
    estimate, units = state.estimate, _units(state)
    if estimate is None:
        return "–", "in this map"
    found = [estimate.cause] if estimate.cause else []
    if estimate.map_from_odom is not None:
        placed = estimate.map_from_odom.target_from_source @ estimate.odom_from_base.target_from_source
        heading_deg = np.degrees(np.arctan2(placed[1, 0], placed[0, 0]))
        found.append(f"at {placed[0, 3]:.2f}, {placed[1, 3]:.2f} {units}, heading {heading_deg:.1f}°")
    if estimate.cov_rot_trans is not None:
        variances = np.diag(np.reshape(estimate.cov_rot_trans, (6, 6)))
        found.append(f"σ {np.sqrt(variances[3:5].max()):.2f} {units}, {np.degrees(np.sqrt(variances[2])):.1f}°")
    return words_of(estimate.status)[0], "; ".join(found) or "place unknown"


def _units(state: LiveSurveyState) -> str:
    return "m" if state.scale_known else "units"


def _hue(number: int) -> int:
    """Degrees, as different as can be from those of the parts before."""
    return round(250 + number * 137.5) % 360


def _layers(state: LiveSurveyState) -> list[Layer]:
    """Landmarks, revisits and the path, coloured by how well it was tracked."""
    way, marks, loops = state.path(), state.rows("landmarks_m"), state.rows("loops_m").tolist()
    if len(way):
        low, high = way[:, :2].min(axis=0) - _BEYOND_M, way[:, :2].max(axis=0) + _BEYOND_M
        marks = marks[((marks > low) & (marks < high)).all(axis=1)][:: max(1, len(marks) // _SHOWN_LANDMARKS)]
    return [
        Layer("Covered", _covered(state.rows("cells"))),
        Layer("Landmarks", [Dots(np.round(marks, 2).ravel().tolist())] if len(marks) else []),
        Layer("Revisits", [Line([(a, b), (c, d)], "accent", "revisit", 1) for a, b, c, d in loops]),
        Layer("Way", [*_part_trails(way, state), *trail(way)]),
        Layer("Now", _now(state, way)),
    ]


def _covered(cells: Array) -> list[Square]:
    """Squares with landmarks, the fuller the darker."""
    size, most = COVERAGE_CELL_M, max(1.0, float(cells[:, 2].max(initial=1.0)))
    return [
        Square((x * size, y * size, (x + 1) * size, (y + 1) * size), "tile", f"{n:.0f} landmarks", round(n / most, 3))
        for x, y, n in cells.tolist()
    ]


def _now(state: LiveSurveyState, way: Array) -> list[Mark]:
    """The newest keyframe, and where directions are missing."""
    lacking = list[Mark]()
    for m in state.missing:
        words = f"nothing looks {m.heading}: {m.places} places were passed the other way"
        lacking.append(Mark(m.x_m, m.y_m, "warn", "triangle", words))
    if not len(way):
        return lacking
    tone = "good" if way[-1, 2] > 0 else "bad"
    return [*lacking, Mark(float(way[-1, 0]), float(way[-1, 1]), tone, "circle", "newest keyframe")]


def _part_trails(way: Array, state: LiveSurveyState) -> list[Line]:
    """A wide line below each part's path, in its colour, where there are several."""
    if len(state.parts) < 2:
        return []
    numbers = state.part_numbers()
    found = []
    for n in range(len(state.parts)):
        places = way[numbers == n, :2]
        found += trail(np.column_stack([places, np.ones(len(places))]), 9, hue=_hue(n))
    return found
