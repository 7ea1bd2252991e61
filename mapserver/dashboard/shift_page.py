"""The shift leader's page: one HTML file without links, made of the parts of the page of trends, light or dark as the screen is."""

from datetime import datetime
from functools import partial
from pathlib import Path

from markupsafe import Markup

from mapserver.api.moments import moment_text
from mapserver.config import MapserverConfig
from mapserver.dashboard import fleet_parts
from mapserver.dashboard.fleet_parts import Bar, Bars, Figure
from mapserver.dashboard.rendering import TEMPLATES, share
from mapserver.fleet.canary_controller import find
from mapserver.fleet.resurvey_list import resurvey_list
from mapserver.fleet_statistics.kpis import HOUR_NS, Counters, Kpis, Rate, format_rate, hour_of, kpis
from mapserver.store import FailureFilter, MapStore

_STYLE = Path(__file__).parent / "static" / "style.css"
_ROWS = 15
_BARS = 24
_SHOWN_FAILURES = 50
_UNKNOWN = "not known"
_USUAL = MapserverConfig()
_moment = partial(moment_text, zone=None)  # by the clock of the machine that writes the page


def html_page(store: MapStore, site: str, hours: int, now_ns: int, config: MapserverConfig = _USUAL) -> str:
    """The page as a file's content: the last `hours` of a site beside as many before; UsageError for an unknown site."""
    current, until, step = store.current(site), hour_of(now_ns) + 1, -(-hours // _BARS)
    since, wanted = until - hours, FailureFilter(site=site, since_ns=(until - hours) * HOUR_NS)
    total = _total(store, site, since, until)
    trials = ((row, find(store, row, config.canary, now_ns)) for row in store.canaries(site)[:1])
    return TEMPLATES.get_template("shift.html").render(
        site=site,
        until_ns=now_ns,
        hours=hours,
        version=None if current is None else current.version,
        total=total,
        style=Markup(_STYLE.read_text("utf-8")),
        shown=_figures(total, _total(store, site, since - hours, since)),
        tried=fleet_parts.trials_shown(trials, _moment),
        by_hour=_by_hour(store.fleet.hours(site, "site", since_hour=since), range(since, until, step)),
        step=step,
        tables={axis: _table(store, site, axis, since) for axis in ("robot", "version", "area", "cause")},
        concerns=resurvey_list(store, site, config.resurvey, now_ns).tiles,
        failures=store.fleet.failures(wanted, limit=_SHOWN_FAILURES),
        most=_ROWS,
        moment=_moment,
        share=_share,
        rate=_rate,
    )


def _total(store: MapStore, site: str, since: int, until: int) -> Kpis:
    return kpis(store.fleet.counters_of(site, "site", since, until).get("", Counters()))


def _table(store: MapStore, site: str, axis: str, since: int) -> list[tuple[str, Kpis]]:
    """The figures of each key, the worst first."""
    rows = [(key, kpis(counts)) for key, counts in store.fleet.counters_of(site, axis, since).items()]
    return sorted(rows, key=lambda row: (-row[1].failures.events, -row[1].silent_estimated.events, row[0]))


def _figures(total: Kpis, before: Kpis) -> list[Figure]:
    """Those that are known."""
    first_fix, frame = total.first_fix_mean_s, total.frame_ms_mean
    found = [
        fleet_parts.localised_figure("Localised while driving", total),
        fleet_parts.rate_figure("Failures per robot-day", total.failures, f"; before: {_rate(before.failures)}"),
        fleet_parts.rate_figure("Silent failures per robot-day, an estimate", total.silent_estimated, ""),
        Figure("Time with a usable position", share(total.availability), f"of {total.observed_h:.1f} h observed"),
        Figure("Localised after the first fix", share(total.localised_share), "of the time since then"),
        Figure("Time to the first fix", None if first_fix is None else f"{first_fix:.1f} s", "mean"),
        Figure("CPU of a frame", None if frame is None else f"{frame:.1f} ms", "mean"),
        Figure("Frames lost", share(total.frame_drop_share), ""),
    ]
    return [figure for figure in found if figure.value is not None]


def _by_hour(found: dict[int, Counters], starts: range) -> Bars:
    """Failures over the time of the page, in bars of so many hours."""
    counts, bars = {hour: kpis(counters).failures.events for hour, counters in found.items()}, []
    for start in starts:
        count = sum(counts.get(hour, 0) for hour in range(start, start + starts.step))
        hour = str(datetime.fromtimestamp(start * HOUR_NS // 10**9).hour)
        words = f"{_moment(start * HOUR_NS)}: {count}"
        bars.append(Bar(hour if starts.step == 1 else "", count, count, count, words))
    return Bars("Failures over time", bars)


def _rate(found: Rate) -> str:
    if found.robot_days <= 0:
        return _UNKNOWN
    return "too little driven" if found.low is None else format_rate(found)


def _share(value: float | None) -> str:
    return share(value) or _UNKNOWN
