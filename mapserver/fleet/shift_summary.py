"""Figures of the shift leader's page, read from the store."""

from dataclasses import dataclass

from mapserver.fleet.canary_controller import find
from mapserver.fleet.resurvey_list import ResurveyList, resurvey_list
from mapserver.fleet_statistics.canary_decision import CanaryFinding, CanarySettings
from mapserver.fleet_statistics.kpis import HOUR_NS, Counters, Kpis, hour_of, kpis
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.store import CanaryRow, FailureFilter, FailureRow, MapStore

_SHOWN_FAILURES = 50


@dataclass(frozen=True, slots=True)
class FleetSummary:
    """One site over some hours. Tables are sorted, the worst first; by_hour: hour since 1970 and its figures."""

    site: str
    until_ns: int
    hours: int
    current_version: int | None
    total: Kpis
    before: Kpis
    robots: list[tuple[str, Kpis]]
    versions: list[tuple[str, Kpis]]
    areas: list[tuple[str, Kpis]]
    causes: list[tuple[str, Kpis]]
    by_hour: list[tuple[int, Kpis]]
    failures: list[FailureRow]
    trials: list[tuple[CanaryRow, CanaryFinding]]
    resurvey: ResurveyList


def summarise(
    store: MapStore,
    site: str,
    hours: int,
    now_ns: int,
    canary: CanarySettings = CanarySettings(),  # noqa: B008  frozen
    resurvey: ResurveySettings = ResurveySettings(),  # noqa: B008
) -> FleetSummary:
    """Return the last `hours` of a site beside as many before; raises UsageError for an unknown site. canary, resurvey: their settings."""
    current = store.current(site)
    until = hour_of(now_ns) + 1
    since = until - hours
    wanted = FailureFilter(site=site, since_ns=since * HOUR_NS)
    return FleetSummary(
        site=site,
        until_ns=now_ns,
        hours=hours,
        current_version=None if current is None else current.version,
        total=_total(store, site, since, until),
        before=_total(store, site, since - hours, since),
        robots=_table(store, site, "robot", since),
        versions=_table(store, site, "version", since),
        areas=_table(store, site, "area", since),
        causes=_table(store, site, "cause", since),
        by_hour=[(hour, kpis(counts)) for hour, counts in store.fleet.hours(site, "site", since_hour=since).items()],
        failures=store.fleet.failures(wanted, limit=_SHOWN_FAILURES),
        trials=[(row, find(store, row, canary, now_ns)) for row in store.canaries(site)[:1]],
        resurvey=resurvey_list(store, site, resurvey, now_ns),
    )


def _total(store: MapStore, site: str, since: int, until: int) -> Kpis:
    found = store.fleet.counters(site, "site", since_hour=since, until_hour=until)
    return kpis(found.get((site, ""), Counters()))


def _table(store: MapStore, site: str, axis: str, since: int) -> list[tuple[str, Kpis]]:
    rows = [(key, kpis(counts)) for (_, key), counts in store.fleet.counters(site, axis, since_hour=since).items()]
    return sorted(rows, key=lambda row: (-row[1].failures.events, -row[1].silent_estimated.events, row[0]))
