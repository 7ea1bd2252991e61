"""The shift leader's page: one HTML file without links, made of the parts of the page of trends, light or dark as the screen is."""

from datetime import datetime
from pathlib import Path

from markupsafe import Markup

from mapserver.api.moments import moment_text
from mapserver.dashboard import fleet_parts
from mapserver.dashboard.fleet_parts import Bar, Bars, Figure
from mapserver.dashboard.rendering import TEMPLATES, share
from mapserver.fleet.shift_summary import FleetSummary
from mapserver.fleet_statistics.kpis import HOUR_NS, Rate, format_rate

_STYLE = Path(__file__).parent / "static" / "style.css"
_ROWS = 15
_BARS = 24
_UNKNOWN = "not known"


def html_page(summary: FleetSummary) -> str:
    """The page as a file's content."""
    step = -(-summary.hours // _BARS)
    return TEMPLATES.get_template("shift.html").render(
        summary=summary,
        style=Markup(_STYLE.read_text("utf-8")),
        shown=_figures(summary),
        tried=fleet_parts.trials_shown((fleet_parts.trial_of(*trial) for trial in summary.trials), _moment),
        by_hour=_by_hour(summary, step),
        step=step,
        most=_ROWS,
        moment=_moment,
        share=_share,
        rate=_rate,
    )


def _moment(stamp_ns: int | None) -> str | None:
    """By the clock of the machine that writes the page."""
    return moment_text(stamp_ns, None)


def _figures(summary: FleetSummary) -> list[Figure]:
    """Those that are known."""
    total = summary.total
    before = f"; before: {_rate(summary.before.failures)}"
    first_fix, frame = total.first_fix_mean_s, total.frame_ms_mean
    found = [
        fleet_parts.localised_figure("Localised while driving", total),
        fleet_parts.rate_figure("Failures per robot-day", total.failures, before),
        fleet_parts.rate_figure("Silent failures per robot-day, an estimate", total.silent_estimated, ""),
        Figure("Time with a usable position", share(total.availability), f"of {total.observed_h:.1f} h observed"),
        Figure("Localised after the first fix", share(total.localised_share), "of the time since then"),
        Figure("Time to the first fix", None if first_fix is None else f"{first_fix:.1f} s", "mean"),
        Figure("CPU of a frame", None if frame is None else f"{frame:.1f} ms", "mean"),
        Figure("Frames lost", share(total.frame_drop_share), ""),
    ]
    return [figure for figure in found if figure.value is not None]


def _by_hour(summary: FleetSummary, step: int) -> Bars:
    """Failures over the time of the page, in bars of so many hours."""
    counts = {hour: found.failures.events for hour, found in summary.by_hour}
    until, bars = summary.until_ns // HOUR_NS + 1, []
    for start in range(until - summary.hours, until, step):
        count = sum(counts.get(hour, 0) for hour in range(start, start + step))
        hour = str(datetime.fromtimestamp(start * HOUR_NS // 10**9).hour)
        words = f"{_moment(start * HOUR_NS)}: {count}"
        bars.append(Bar(hour if step == 1 else "", count, count, count, words))
    return Bars("Failures over time", bars)


def _rate(found: Rate) -> str:
    if found.robot_days <= 0:
        return _UNKNOWN
    return "too little driven" if found.low is None else format_rate(found)


def _share(value: float | None) -> str:
    return share(value) or _UNKNOWN
