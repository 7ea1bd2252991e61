"""What the page of trends and that of the shift leader show of a fleet; templates/fleet_parts.html draws it."""

from collections.abc import Callable, Iterable, Sequence
from datetime import tzinfo
from typing import NamedTuple

from mapserver.api.moments import steps
from mapserver.dashboard.rendering import begun, share
from mapserver.fleet.alerts import Incident
from mapserver.fleet_statistics.canary_decision import CanaryFinding
from mapserver.fleet_statistics.kpis import HOUR_NS, Kpis, Rate, driven_words, figure, format_rate
from mapserver.fleet_statistics.robot_calibration import CalibrationFigure
from mapserver.store import CanaryRow

_TRIAL_WORDS = {
    "running": ("warn", "is tried by {share} of the robots since {when}"),
    "promoted": ("good", "was tried by {share} of the robots and promoted at {when}"),
    "rolled_back": ("bad", "was tried by {share} of the robots and rolled back at {when}"),
    "stopped": ("warn", "was tried by {share} of the robots until the trial was stopped at {when}"),
}

_STEPS_NS = {
    HOUR_NS // 12: "5 minutes",
    HOUR_NS: "an hour",
    6 * HOUR_NS: "6 hours",
    24 * HOUR_NS: "a day",
    168 * HOUR_NS: "a week",
    28 * 24 * HOUR_NS: "4 weeks",
    364 * 24 * HOUR_NS: "52 weeks",
}
_BARS = 42

Choice = tuple[str, bool, str]
"""Something to choose or to take back: its words, whether it is chosen, and the address that does it."""


# The page that says more of an incident; "{}": what it is about.
_PAGES = {"draft": "map", "recording": "surveys", "failure": "failures/{}", "FleetmapFailureRate": "failures"}
_PAGES |= {"FleetmapNightFailed": "surveys", "FleetmapCanaryRolledBack": "trends"}
_PAGES |= {"FleetmapDiskFills": "administration", "FleetmapTrustFault": "administration"}


def page_of(incident: Incident) -> str:
    """The path of the page that says more of an incident, that of its robot for alerts of robots."""
    return _PAGES.get(incident.name, "robots/{}").format(incident.about)


class Figure(NamedTuple):
    """A large value with a remark below. tone: as of a badge, or empty."""

    name: str
    value: object
    remark: str
    tone: str = ""


class Sentence(NamedTuple):
    """What a page begins with: its tone, since which moment it is so, and what to do."""

    tone: str
    words: str
    exact: str = ""
    advice: str = ""


class Bar(NamedTuple):
    """A rate with its interval; value None where nothing was driven."""

    label: str
    value: float | None
    low: float | None
    high: float | None
    words: str


class Bars(NamedTuple):
    """Rates side by side. span: from when until when, nanoseconds since 1970, where a time is chosen by dragging in them."""

    name: str
    bars: list[Bar]
    span: tuple[int, int] | None = None

    @property
    def top(self) -> float:
        """The end of the scale, the next of 1, 2, 5, 10, 20, ...; intervals that are very wide go beyond it."""
        highest = max([0.5, *(bar.value for bar in self.bars if bar.value is not None)])
        wanted = min(3 * highest, max([highest, *(bar.high for bar in self.bars if bar.high is not None)]))
        steps = (digit * 10.0**power for power in range(-1, 9) for digit in (1, 2, 5))
        return next((step for step in steps if step >= wanted), wanted)


Trial = tuple[CanaryRow, CanaryFinding]
"""A version that some robots try, or tried in the last days, and what is known about it so far."""


def bar_edges(first_ns: int, end_ns: int, zone: tzinfo | None, least_ns: int = 0) -> tuple[list[int], str]:
    """The edges of the bars that show a time, each as long as the words say, and no shorter than `least_ns`."""
    wide = (step_ns for step_ns in _STEPS_NS if step_ns >= least_ns and (end_ns - first_ns) / step_ns < _BARS)
    step_ns = next(wide, max(_STEPS_NS))
    return steps(first_ns, end_ns, step_ns, zone), _STEPS_NS[step_ns]


def rate_figure(name: str, found: Rate, more: str) -> Figure:
    """A rate with its interval; a dash where too little was driven."""
    if found.robot_days <= 0:
        return Figure(name, "–", f"nothing was driven{more}")
    counted = f"{found.events} in {driven_words(found.robot_days)}"
    if found.low is None:
        return Figure(name, "–", f"{counted}: too little for a rate{more}")
    interval = f"{figure(found.low)} to {figure(found.high)} with 95 %"
    return Figure(name, figure(found.per_robot_day), f"{counted}: {interval}{more}")


def localised_figure(name: str, found: Kpis) -> Figure:
    """The share of all driving time in which robots were localised, and the time in which they were not."""
    lost_min = 60 * found.not_localised_h
    words = f"{lost_min:.0f} min" if lost_min < 120 else f"{found.not_localised_h:.1f} h"
    shown = share(found.localised_share_of_all)
    return Figure(name, shown or "–", f"{words} driven without being localised" if shown else "nothing was driven")


def trial_words(trial: Trial, moment: Callable[[int | None], str | None]) -> tuple[str, str, str]:
    """Tone, what became of a trial, and what was found, empty before. moment: a stamp as people read it."""
    canary, found = trial
    finding = canary.outcome or found.reason  # what became of one that has ended stays
    tone, sentence = _TRIAL_WORDS[canary.state]
    when = moment(canary.started_ns if canary.ended_ns is None else canary.ended_ns)
    words = f"Version {canary.version} {sentence.format(share=share(canary.share), when=when)}."
    return tone, words, f"{begun(finding)}." if finding else ""


def trials_shown(
    found: Iterable[Trial], moment: Callable[[int | None], str | None]
) -> list[tuple[str, str, str, Bars | None]]:
    """Of each trial the words, and the rates of both sides once they tell something."""
    shown = []
    for canary, finding in found:
        sides = (finding.canary, finding.others)
        labels = f"version {canary.version}", f"others, version {canary.base_version}"
        name = f"Failures per robot-day with version {canary.version} and with the others"
        drawn = Bars(name, [rate_bar(*side) for side in zip(labels, sides, strict=True)])
        shown.append(
            (*trial_words((canary, finding), moment), drawn if any(side.low is not None for side in sides) else None)
        )
    return shown


def cameras(
    robots: Iterable[tuple[str, Sequence[CalibrationFigure]]],
) -> list[tuple[str, dict[str, CalibrationFigure]]]:
    """What the map shows of the robots' cameras by parameter, those that drift first; robots that do not report it are left out."""
    found = [(robot, {one.name: one for one in told}) for robot, told in robots if told]
    return sorted(found, key=lambda item: (not any(one.is_drifted for one in item[1].values()), item[0]))


def rate_bar(label: str, found: Rate) -> Bar:
    """A bar of failures per robot-day; none where too little was driven."""
    words = f"{found.events} in {driven_words(found.robot_days)}: {format_rate(found)} per robot-day"
    return Bar(label, found.per_robot_day, found.low, found.high, words)
