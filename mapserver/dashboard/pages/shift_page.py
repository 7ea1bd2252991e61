"""The shift leader's page: one HTML file without links, made of the parts of the page of trends, light or dark as the screen is."""

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from markupsafe import Markup

from mapserver.api.moments import moment_text
from mapserver.dashboard import bar_chart, fleet_parts
from mapserver.dashboard.bar_chart import Bar
from mapserver.dashboard.fleet_parts import Figure, trial_of
from mapserver.dashboard.markup import joined, share, table
from mapserver.fleet.shift_summary import FleetSummary
from mapserver.fleet_statistics.kpis import HOUR_NS, Kpis, Rate, format_rate, is_telling

_STYLE = Path(__file__).parents[1] / "style.css"
_ROWS = 15
_BARS = 24
_UNKNOWN = "not known"


def html_page(summary: FleetSummary) -> str:
    """The page as a file's content."""
    heading = Markup(
        "<h1>Robots of {}</h1><p>{}, the last {} h, map version {}. A robot-day is 16 hours of driving.</p>"
    ).format(summary.site, _moment(summary.until_ns), summary.hours, summary.current_version or "none")
    parts = (
        heading,
        _figures(summary),
        _unreported(summary.total.unreported_blindness),
        fleet_parts.trial_notices((trial_of(row, found) for row, found in summary.trials), _moment),
        _by_hour(summary),
        _kpis_table("Robots, the worst first", "Robot", summary.robots),
        _kpis_table("Map versions", "Version", summary.versions),
        _kpis_table("Areas, the worst first", "Area", summary.areas),
        _causes(summary),
        fleet_parts.resurvey(summary.resurvey.tiles),
        _failures(summary),
    )
    page = Markup(
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Fleet of {}</title>'
        '<meta name="viewport" content="width=device-width"><style>{}</style></head>'
        '<body class="print"><main class="nicegui-content">\n{}\n</main></body></html>\n'
    )
    return str(page.format(summary.site, Markup(_STYLE.read_text("utf-8")), joined(parts, "\n")))


def _moment(stamp_ns: int | None) -> str | None:
    """By the clock of the machine that writes the page."""
    return moment_text(stamp_ns, None)


def _figures(summary: FleetSummary) -> Markup:
    total = summary.total
    lost = f"{_number(total.frame_ms_mean, 'ms')} of CPU per frame"
    return fleet_parts.figures(
        [
            fleet_parts.localised_figure("Localised while driving", total),
            fleet_parts.rate_figure(
                "Failures per robot-day", total.failures, f"; before: {_rate(summary.before.failures)}"
            ),
            fleet_parts.rate_figure("Silent failures per robot-day, an estimate", total.silent_estimated, ""),
            Figure("Time with a usable position", _share(total.availability), f"of {total.observed_h:.1f} h observed"),
            Figure("Localised after the first fix", _share(total.localised_share), "of the time since then"),
            Figure("Time to the first fix", _number(total.first_fix_mean_s, "s"), "mean"),
            Figure("Frames lost", _share(total.frame_drop_share), lost),
        ]
    )


def _unreported(count: int) -> Markup:
    if not count:
        return Markup("")
    return Markup(
        '<p class="notice bad">{} times a robot was blind or did not find itself, and reported no failure (yet): a report may be on its '
        "way, or the robot does not report.</p>"
    ).format(count)


def _by_hour(summary: FleetSummary) -> Markup:
    """Failures over the time of the page, in at most `_BARS` bars."""
    counts = {hour: found.failures.events for hour, found in summary.by_hour}
    until = summary.until_ns // HOUR_NS + 1
    step = -(-summary.hours // _BARS)
    bars = []
    for start in range(until - summary.hours, until, step):
        count = sum(counts.get(hour, 0) for hour in range(start, start + step))
        words = f"{_moment(start * HOUR_NS)}: {count}"
        hour = str(datetime.fromtimestamp(start * HOUR_NS // 10**9).hour)
        bars.append(Bar(hour if step == 1 else "", count, count, count, words))
    drawn = bar_chart.bars(bars, "Failures over time")
    span = "an hour" if step == 1 else f"{step} hours"
    return Markup('<h2>Failures over time</h2>{}<p class="quiet">A bar for {}.</p>').format(drawn, span)


def _kpis_table(title: str, name: str, rows: Sequence[tuple[str, Kpis]]) -> Markup:
    if not rows:
        return Markup("")
    body = [
        (
            key or "none",
            _share(found.localised_share_of_all),
            found.failures.events + found.failures_running,
            _rate(found.failures),
            found.silent_estimated.events,
            f"{found.driving_h:.1f}",
            _share(found.availability),
            _share(found.frame_drop_share),
        )
        for key, found in rows[:_ROWS]
    ]
    head = (name, "Localised", "Failures", "Per robot-day", "Suspected", "Hours driven", "Usable", "Frames lost")
    more = f"and {len(rows) - _ROWS} more" if len(rows) > _ROWS else ""
    shown = table(head, body, empty="", name=title)
    return Markup('<h2>{}</h2>{}<p class="quiet">{}</p>').format(title, shown, more)


def _causes(summary: FleetSummary) -> Markup:
    rows = [(key, found.failures.events, found.silent_estimated.events) for key, found in summary.causes[:_ROWS]]
    if not rows:
        return Markup("")
    return Markup("<h2>Causes</h2>{}").format(table(("Cause", "Failures", "Suspected"), rows, empty="", name="Causes"))


def _failures(summary: FleetSummary) -> Markup:
    rows = [
        (
            _moment(row.happened_ns),
            row.robot,
            row.kind.replace("_", " "),
            row.cause.replace("_", " "),
            row.version,
            row.where,
            f"{row.duration_s:.1f} s",
        )
        for row in summary.failures
    ]
    head = ("When", "Robot", "Kind", "Cause", "Map version", "Where", "Duration")
    shown = table(head, rows, empty="No failures were reported.", name="Last failures")
    return Markup("<h2>Last failures</h2>{}").format(shown)


def _rate(found: Rate) -> str:
    if found.robot_days <= 0:
        return _UNKNOWN
    return format_rate(found) if is_telling(found) else "too little driven"


def _share(value: float | None) -> str:
    return share(value) or _UNKNOWN


def _number(value: float | None, unit: str) -> str:
    return _UNKNOWN if value is None else f"{value:.1f} {unit}"
