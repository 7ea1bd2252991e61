"""The shift leader's page: one HTML file that needs nothing else, light or dark as the screen is."""

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from html import escape

from mapserver.fleet.shift_summary import FleetSummary
from mapserver.fleet_statistics.kpis import HOUR_NS, Kpis, Rate
from mapserver.fleet_statistics.rate_format import driven_words, is_telling, rate_words

_STYLE = """
:root { color-scheme: light dark; --ink: #1a1a1a; --paper: #fff; --faint: #666; --line: #ccc; --bad: #b3261e; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e8e8e8; --paper: #161616; --faint: #a0a0a0; --line: #444; --bad: #ff8a80; } }
body { font: 16px/1.45 system-ui, sans-serif; color: var(--ink); background: var(--paper); margin: 1.5rem auto;
  max-width: 62rem; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin: 0 0 .25rem; } h2 { font-size: 1.1rem; margin: 2rem 0 .5rem; }
p, td { overflow-wrap: anywhere; } .faint { color: var(--faint); } .bad { color: var(--bad); font-weight: 600; }
table { border-collapse: collapse; width: 100%; } th, td { text-align: left; padding: .3rem .8rem .3rem 0;
  border-bottom: 1px solid var(--line); vertical-align: top; } td.n, th.n { text-align: right; }
.figures { display: flex; flex-wrap: wrap; gap: 1rem 2.5rem; margin: 1rem 0; }
.figures b { display: block; font-size: 1.6rem; } rect { fill: var(--bad); } line { stroke: var(--line); }
"""
_ROWS = 15


def html_page(summary: FleetSummary) -> str:
    """The page."""
    total = summary.total
    parts = [
        f"<h1>Site {escape(summary.site)}: robots and their map</h1>",
        f'<p class="faint">{_when(summary.until_ns)} UTC, the last {summary.hours} h, map version '
        f"{summary.current_version or 'none'}. A robot-day is 16 h of driving; ranges hold the true rate with 95 %.</p>",
        _figures(summary),
        _canary(summary),
        _trend(summary),
        _kpis_table("Robots, the worst first", "robot", summary.robots),
        _kpis_table("Map versions", "version", summary.versions),
        _causes(summary),
        _resurvey(summary),
        _failures(summary),
    ]
    if total.unreported_blindness:
        parts.insert(3, _unreported(total.unreported_blindness))
    title = f"Fleet of {escape(summary.site)}"
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body>\n'
        + "\n".join(part for part in parts if part)
        + "\n</body></html>\n"
    )


def _figures(summary: FleetSummary) -> str:
    total, before = summary.total, summary.before
    figures = [
        (
            "failures per robot-day",
            _rate(total.failures),
            f"{total.failures.events} in all, in {driven_words(total.failures.robot_days)}; before: {_rate(before.failures)}",
        ),
        ("silent ones, an estimate", _rate(total.silent_estimated), f"{total.silent_estimated.events} suspected"),
        ("usable position", _percent(total.availability), f"of {total.observed_h:.1f} h observed"),
        ("localised", _percent(total.localised_share), "of the time after the first fix"),
        ("to the first fix", _number(total.first_fix_mean_s, "s"), "mean"),
        ("frames lost", _percent(total.frame_drop_share), f"{_number(total.frame_ms_mean, 'ms')} of CPU per frame"),
    ]
    cells = (
        f'<div>{escape(name)}<b>{escape(value)}</b><span class="faint">{escape(note)}</span></div>'
        for name, value, note in figures
    )
    return f'<div class="figures">{"".join(cells)}</div>'


def _unreported(count: int) -> str:
    return (
        f'<p class="bad">{count} times a robot was blind without reporting a failure (yet): a report may be on its way, or the '
        "robot does not report.</p>"
    )


def _canary(summary: FleetSummary) -> str:
    if summary.canary is None:
        return ""
    row, finding = summary.canary
    told = {
        "running": f"Version {row.version} is tried by {row.share:.0%} of the robots: {finding.reason}",
        "promoted": f"Version {row.version} was tried and promoted: {row.outcome}",
        "rolled_back": f"Version {row.version} was tried and taken back: {row.outcome}",
        "stopped": f"The trial of version {row.version} ended: {row.outcome}",
    }[row.state]
    bad = ' class="bad"' if row.state == "rolled_back" else ""
    return f"<h2>New map on trial</h2><p{bad}>{escape(told)}.</p>"


def _trend(summary: FleetSummary) -> str:
    """Failures by the hour as bars."""
    since = max(summary.until_ns // HOUR_NS + 1 - summary.hours, 0)
    counts = {hour: found.failures.events for hour, found in summary.by_hour}
    most = max(counts.values(), default=0)
    if most == 0:
        return ""
    step = 600 / summary.hours
    bars = "".join(
        f'<rect x="{(hour - since) * step:.1f}" y="{80 - 76 * count / most:.1f}" width="{max(1.0, 0.8 * step):.1f}" '
        f'height="{76 * count / most:.1f}"><title>{_when(hour * HOUR_NS)}: {count}</title></rect>'
        for hour, count in counts.items()
        if count
    )
    span = f"from {_when(since * HOUR_NS)} to {_when(summary.until_ns)} UTC, at most {most} in an hour"
    return (
        f'<h2>Failures by the hour</h2><svg viewBox="0 0 600 82" width="100%" role="img" aria-label="failures by the hour">'
        f'<line x1="0" y1="80.5" x2="600" y2="80.5"/>{bars}</svg><p class="faint">{span}</p>'
    )


def _kpis_table(title: str, name: str, rows: Sequence[tuple[str, Kpis]]) -> str:
    body = [
        (
            key or "none", str(found.failures.events), _rate(found.failures), str(found.silent_estimated.events),
            f"{found.driving_h:.1f}", _percent(found.availability), _percent(found.localised_share),
            _percent(found.frame_drop_share),
        )
        for key, found in rows[:_ROWS]
    ]  # fmt: skip
    heads = (name, "failures", "per robot-day", "suspected", "hours driven", "usable", "localised", "frames lost")
    more = f'<p class="faint">and {len(rows) - _ROWS} more</p>' if len(rows) > _ROWS else ""
    return f"<h2>{escape(title)}</h2>{_table(heads, body)}{more}" if rows else ""


def _causes(summary: FleetSummary) -> str:
    rows = [
        (cause, str(found.failures.events), str(found.silent_estimated.events))
        for cause, found in summary.causes[:_ROWS]
    ]
    return f"<h2>Causes</h2>{_table(('cause', 'failures', 'suspected'), rows)}" if rows else ""


def _resurvey(summary: FleetSummary) -> str:
    rows = [(concern.tile, "; ".join(concern.reasons)) for concern in summary.resurvey.tiles]
    if not rows:
        return "<h2>Survey again</h2><p>Nothing: no tile has clearly more failures or fewer landmarks than before.</p>"
    return f"<h2>Survey again</h2>{_table(('tile', 'why'), rows)}"


def _failures(summary: FleetSummary) -> str:
    rows = [
        (
            _when(failure.happened_ns), failure.robot, failure.kind, failure.cause, str(failure.version or "none"),
            failure.tile or "unknown", f"{failure.duration_s:.1f}",
        )
        for failure in summary.failures
    ]  # fmt: skip
    heads = ("when (UTC)", "robot", "kind", "cause", "version", "tile", "seconds")
    return f"<h2>Last failures</h2>{_table(heads, rows)}" if rows else "<h2>Last failures</h2><p>None was reported.</p>"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _rate(found: Rate) -> str:
    if found.robot_days <= 0:
        return "not known"
    return rate_words(found) if is_telling(found) else "too little driven"


def _percent(value: float | None) -> str:
    return "not known" if value is None else f"{value:.1%}"


def _number(value: float | None, unit: str) -> str:
    return "not known" if value is None else f"{value:.1f} {unit}"


def _when(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M")
