"""Parts of the page of trends and of the shift leader's page: figures, trials, failure rates, what got worse, tiles to survey again."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from markupsafe import Markup

from mapserver.dashboard import bar_chart
from mapserver.dashboard.bar_chart import Bar
from mapserver.dashboard.markup import badge, joined, link, share, table
from mapserver.fleet_statistics.area_trend import AreaTrend, Verdict, trend_sentence
from mapserver.fleet_statistics.canary_decision import CanaryFinding
from mapserver.fleet_statistics.kpis import Kpis, Rate, driven_words, figure, format_rate, is_telling
from mapserver.fleet_statistics.resurvey_decision import TileConcern
from mapserver.fleet_statistics.robot_calibration import PARAMETERS, CalibrationFigure
from mapserver.floor_plan.areas import OUTSIDE
from mapserver.store import CanaryRow

_TRIAL_WORDS = {
    "running": ("warn", "is tried by {share} of the robots since {when}"),
    "promoted": ("good", "was tried by {share} of the robots and promoted at {when}"),
    "rolled_back": ("bad", "was tried by {share} of the robots and rolled back at {when}"),
    "stopped": ("warn", "was tried by {share} of the robots until the trial was stopped at {when}"),
}
_TREND_TONES: dict[Verdict, str] = {
    "worse": "bad",
    "better": "good",
    "no clear change": "quiet",
    "too little driving to say": "quiet",
}
_TRENDS_SHOWN = 20


class Figure(NamedTuple):
    """A large value with a remark below. tone: as of a badge, or empty."""

    name: str
    value: object
    remark: str
    tone: str = ""


class Trial(NamedTuple):
    """A version that some robots try, or tried in the last days, what is known about it so far, and how often both sides failed."""

    canary: CanaryRow
    finding: str
    tried: Rate
    others: Rate


def trial_of(canary: CanaryRow, found: CanaryFinding) -> Trial:
    """A trial as pages show it; the outcome of one that has ended stays what it was."""
    return Trial(canary, canary.outcome or found.reason, found.canary, found.others)


def figures(found: Iterable[Figure]) -> Markup:
    """Figures side by side."""
    box = Markup('<div><div class="name">{}</div><div class="value {}">{}</div><div class="more">{}</div></div>')
    return Markup('<div class="figures">{}</div>').format(
        joined(box.format(figure.name, figure.tone, figure.value, figure.remark) for figure in found)
    )


def rate_figure(name: str, found: Rate, more: str) -> Figure:
    """A rate with its interval; a dash where too little was driven."""
    if found.low is None:
        return Figure(name, "–", f"nothing was driven{more}")
    counted = f"{found.events} in {driven_words(found.robot_days)}"
    if not is_telling(found):
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
    """Tone, what became of a trial, and what was found, empty before."""
    canary, finding = trial.canary, trial.finding
    tone, sentence = _TRIAL_WORDS[canary.state]
    when = moment(canary.started_ns if canary.ended_ns is None else canary.ended_ns)
    words = f"Version {canary.version} {sentence.format(share=share(canary.share), when=when)}."
    return tone, words, f"{finding[:1].upper()}{finding[1:]}." if finding else ""


def trial_notices(trials: Iterable[Trial], moment: Callable[[int | None], str | None]) -> Markup:
    """The running trial of a version, and how those before it ended; moment: a stamp as people read it."""
    notice = Markup('<div class="notice {}" role="status"><strong>{}</strong><br>{}</div>')
    parts = []
    for trial in trials:
        canary = trial.canary
        parts.append(notice.format(*trial_words(trial, moment)))
        sides = ((f"version {canary.version}", trial.tried), (f"others, version {canary.base_version}", trial.others))
        name = f"Failures per robot-day with version {canary.version} and with the others"
        if any(map(is_telling, (trial.tried, trial.others))):
            drawn = bar_chart.bars([rate_bar(label, rate) for label, rate in sides], name)
            parts.append(
                Markup('<figure class="sides">{}<figcaption class="quiet">{}</figcaption></figure>').format(drawn, name)
            )
    return joined(parts)


def rate_bar(label: str, found: Rate) -> Bar:
    """A bar of failures per robot-day; none where too little was driven."""
    words = f"{found.events} in {driven_words(found.robot_days)}: {format_rate(found)} per robot-day"
    if not is_telling(found):
        return Bar(label, None, None, None, words)
    return Bar(label, found.per_robot_day, found.low, found.high, words)


def rates(found: list[Bar], remark: str) -> Markup:
    """Failure rates side by side."""
    return Markup(
        '<h2>Failures per robot-day</h2>{}<p class="quiet">A robot-day is 16 hours of driving. The thin line is the 95 % interval of '
        "the true rate; periods with little driving have no bar. {}</p>"
    ).format(bar_chart.bars(found, "Failures per robot-day"), remark)


def got_worse(trends: Sequence[AreaTrend], area_address: Callable[[str], str], *, has_areas: bool) -> Markup:
    """Areas of the last 7 days beside the 7 days before. has_areas: they have names, else they are tiles."""
    head = (
        "Area" if has_areas else "Tile", "Against the week before", "How often robots fail there now",
        "Failures per robot-day, 7 days", "7 days before", "Localised while driving", "7 days before",
    )  # fmt: skip
    rows = [
        (
            trend.name if trend.name == OUTSIDE else link(area_address(trend.name), trend.name),
            badge(_TREND_TONES[trend.verdict], trend.verdict),
            trend.times_words,
            _counted(trend.now),
            _counted(trend.before),
            share(trend.localised_now),
            share(trend.localised_before),
        )
        for trend in trends[:_TRENDS_SHOWN]
    ]
    listed = table(head, rows, empty="Nothing was driven in these two weeks.", name="What got worse this week")
    more = f" {len(trends) - _TRENDS_SHOWN} more are not shown." if len(trends) > _TRENDS_SHOWN else ""
    named = "" if has_areas else " No area is named here; `mapserver areas import FILE` names them."
    remark = (
        "The last 7 days beside the 7 before. Worse and better are beyond chance: the intervals of how often hold all true values "
        f"together with 95 %.{named}{more}"
    )
    answer = f"{trend_sentence(list(trends))}." if trends else ""
    return Markup('<h2 id="worse">What got worse this week</h2><p>{}</p>{}<p class="quiet">{}</p>').format(
        answer, listed, remark
    )


def _counted(found: Rate) -> str:
    return f"{format_rate(found)}: {found.events} in {driven_words(found.robot_days)}"


def resurvey(concerns: Sequence[TileConcern], tile_address: Callable[[str], str] | None = None) -> Markup:
    """Tiles to survey again, with links to their failures where the page has any."""
    if not concerns:
        return Markup("<h2>Survey again</h2><p>{} No tile stands out.</p>").format(badge("good", "nothing"))
    rows = [
        (
            concern.name if tile_address is None else link(tile_address(concern.tile), concern.name),
            "; ".join(concern.reasons),
            format_rate(concern.failures),
            format_rate(concern.failures_before),
        )
        for concern in concerns
    ]
    head = ("Tile", "Why", "Recent failures per robot-day", "Before")
    return Markup("<h2>Survey again</h2>{}").format(table(head, rows, empty="", name="Tiles to survey again"))


def calibrations(robots: Sequence[tuple[str, Sequence[CalibrationFigure]]]) -> Markup:
    """What the map shows of the robots' cameras, those that drift first; nothing where no robot reports it."""
    if not robots:
        return Markup("")
    shown = [name for name in PARAMETERS if any(one.name == name for _, found in robots for one in found)]
    rows = []
    for robot, found in sorted(robots, key=lambda item: (not any(one.is_drifted for one in item[1]), item[0])):
        by_name = {one.name: one for one in found}
        drifted = any(one.is_drifted for one in found)
        state = badge("bad", "drifts") if drifted else badge("good", "agrees")
        rows.append((robot, state, *(_calibration_cell(by_name.get(name)) for name in shown)))
    head = ("Robot", "Calibration", *(PARAMETERS[name] for name in shown))
    return Markup(
        "<h2>Cameras against the map</h2>{}"
        '<p class="quiet">What the map shows minus what a robot\'s calibration says, with its standard deviation. A robot whose camera '
        "drifts says DEGRADED: look at its mounting and calibrate it again.</p>"
    ).format(table(head, rows, empty="", name="Calibration of the robots' cameras"))


def _calibration_cell(found: CalibrationFigure | None) -> Markup | str:
    if found is None:
        return "–"
    return badge("bad", found.words) if found.is_drifted else found.words
