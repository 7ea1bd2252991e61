"""Fleet health for the pages: rates with their intervals, failures, versions on trial."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from fleetmap.errors import RecordingError
from fleetmap.failure_summary import Moment, decode_summary
from fleetmap.messages import CameraNote
from mapserver.api.moments import hours_within
from mapserver.dashboard.data import MANY_SITES, Kept
from mapserver.dashboard.fleet_parts import Trial
from mapserver.fleet.alerts import Incident
from mapserver.fleet.canary_controller import find
from mapserver.fleet.resurvey_list import resurvey_list
from mapserver.fleet_statistics.area_trend import AreaTrend, area_trends
from mapserver.fleet_statistics.canary_decision import CanarySettings
from mapserver.fleet_statistics.kpis import HOUR_NS, Counters, Kpis, Rate, hour_of, kpis, rate
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings, TileConcern
from mapserver.store import FailureFilter, FailureRow, MapStore

_log = logging.getLogger(__name__)
DAY_H, WEEK_H = 24, 7 * 24
DAYS_SHOWN = 14
FAILURES_SHOWN = 50
MANY_FAILURES = 5000
NEAR_NS = 60_000_000_000  # of a failure's beginning
_CACHED_NS = 5_000_000_000
_ENDED_SHOWN_NS = 7 * DAY_H * HOUR_NS
_TRENDS = {
    "worse": "more than in the week before",
    "better": "fewer than in the week before",
    "no clear change": "no clear change from the week before",
    "too little driving to say": "too little driving to compare with the week before",
}


class SiteHealth(NamedTuple):
    """A site's figures. day: the last 24 h; days: rates of 24 h each, oldest first, the last ends now.

    robots: each one's figures of the last 24 h. trend: how day compares with the 7 days before, in words. areas: the last 7 days beside
    the 7 before them by named area, or by tile where none is named. alerts: of the site and the server.
    """

    day: Kpis
    trend: str
    days: tuple[Rate, ...]
    robots: Mapping[str, Kpis]
    trials: tuple[Trial, ...]
    resurvey: tuple[TileConcern, ...]
    areas: tuple[AreaTrend, ...]
    alerts: tuple[Incident, ...]


class HealthData:
    """Reads fleet health from an open store. Thread-safe; errors are the store's."""

    def __init__(
        self, store: MapStore, canary: CanarySettings, resurvey: ResurveySettings, clock_ns: Callable[[], int],
        alerts: Callable[[int], Iterable[Incident]],
    ) -> None:  # fmt: skip
        self._store, self._canary, self._resurvey, self._clock_ns = store, canary, resurvey, clock_ns
        self._alerts, self._sites = alerts, Kept[SiteHealth](MANY_SITES, _CACHED_NS, clock_ns)

    def site(self, site: str) -> SiteHealth:
        """A site's figures, a few seconds old at most, computed once for all open pages."""
        return self._sites.get(site, lambda: self._site(site))

    def span(self, site: str, since_ns: int | None, until_ns: int | None) -> Kpis:
        """A site's figures of whole hours: those that both ends lie in, too."""
        first, end = hours_within(since_ns or 0, until_ns, self._clock_ns(), 0)
        return kpis(_sum(self._store.fleet.hours(site, "site", since_hour=first, until_hour=end), first, end))

    def rates(self, site: str, edges_ns: Sequence[int]) -> list[Rate]:
        """Failures per robot-day between each two edges, in the whole hours that end after the one and not after the other."""
        edges = [hour_of(edge_ns) for edge_ns in edges_ns]
        hours = self._store.fleet.hours(site, "site", since_hour=edges[0], until_hour=edges[-1])
        counts = [_sum(hours, *span) for span in pairwise(edges)]
        return [rate(each.position_failures, each.robot_days) for each in counts]

    def places(self, site: str, since_ns: int | None = None, until_ns: int | None = None) -> list[tuple[float, float]]:
        """Where failures of a time began; without one, of the days that are shown."""
        if since_ns is None and until_ns is None:
            since_ns = self._clock_ns() - DAYS_SHOWN * DAY_H * HOUR_NS
        wanted = FailureFilter(site=site, since_ns=since_ns, until_ns=until_ns)
        return places_of(self._store.fleet.failures(wanted, limit=MANY_FAILURES))

    def cameras(self, site: str) -> dict[str, CameraNote]:
        """The robots' cameras as the newest failure report of each tells it; robots without one are left out."""
        newest: dict[str, int] = {}
        for row in self._store.fleet.failures(FailureFilter(site=site), limit=MANY_FAILURES):
            newest.setdefault(row.robot, row.number)
        told = {robot: self._store.fleet.failure(number).report.camera for robot, number in newest.items()}
        return {robot: camera for robot, camera in told.items() if camera is not None}

    def moments(self, number: int, began_ns: int) -> list[Moment]:
        """What the robot said within a minute of a failure's beginning; nothing without a recording, and for one of another fleetmap."""
        found = self._store.fleet.replay_summary(number)
        try:
            told = () if found is None else decode_summary(found).moments
        except RecordingError as error:
            _log.warning("failure %d is shown without its recording: %s", number, error)
            return []
        return [each for each in told if abs(each.stamp_ns - began_ns) <= NEAR_NS]

    def _site(self, site: str) -> SiteHealth:
        now_ns = self._clock_ns()
        next_hour = hour_of(now_ns) + 1
        hours = self._store.fleet.hours(site, "site", since_hour=next_hour - DAY_H * DAYS_SHOWN)
        days = [_sum(hours, next_hour - DAY_H * (n + 1), next_hour - DAY_H * n) for n in reversed(range(DAYS_SHOWN))]
        week = _sum(hours, next_hour - DAY_H * 8, next_hour - DAY_H)
        robots = self._store.fleet.counters_of(site, "robot", next_hour - DAY_H)
        ended_ns = now_ns - _ENDED_SHOWN_NS
        trials = [row for row in self._store.canaries(site) if row.ended_ns is None or row.ended_ns > ended_ns][:3]
        is_mapped = any(info.site == site for info in self._store.sites())
        return SiteHealth(
            kpis(days[-1]),
            _TRENDS[area_trends({"": days[-1]}, {"": week})[0].verdict],
            tuple(rate(counts.position_failures, counts.robot_days) for counts in days),
            {robot: kpis(counts) for robot, counts in robots.items()},
            tuple((row, find(self._store, row, self._canary, now_ns)) for row in trials),
            tuple(resurvey_list(self._store, site, self._resurvey, now_ns).tiles) if is_mapped else (),
            tuple(self.area_trends(site, None, None)),
            tuple(alert for alert in self._alerts(now_ns) if alert.site in {"", site}),
        )

    def area_trends(self, site: str, since_ns: int | None, until_ns: int | None) -> list[AreaTrend]:
        """Areas in whole hours of a time, or tiles where none is named, beside the 7 days before it; without a start its last 7 days."""
        first, end = hours_within(since_ns, until_ns, self._clock_ns(), WEEK_H)
        axis = "area" if self._store.areas(site) else "tile"
        spans = (first, end), (first - WEEK_H, first)
        return area_trends(*(self._store.fleet.counters_of(site, axis, *span) for span in spans))


def places_of(rows: Iterable[FailureRow]) -> list[tuple[float, float]]:
    """Where failures began, as far as that is known."""
    return [(row.x_map_m, row.y_map_m) for row in rows if row.x_map_m is not None and row.y_map_m is not None]


def _sum(hours: Mapping[int, Counters], since: int, until: int) -> Counters:
    total, first = Counters(), hours.get(since, Counters())
    for hour, counts in hours.items():
        if since <= hour < until:
            total.add(counts)
    total.continued = first.continued
    return total
