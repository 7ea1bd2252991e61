"""The fleet's health as Prometheus metrics. Labels: sites, versions that the store has, causes (at most some dozens), statuses."""

from collections import Counter
from collections.abc import Callable, Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from fleetmap.messages import Status
from mapserver.fleet.fleet import Fleet, RobotStatus
from mapserver.fleet_statistics.kpis import Counters
from mapserver.store import MapStore

_SILENT_AFTER_S = 60.0

_SITE_SUMS: tuple[tuple[str, str, Callable[[Counters], float]], ...] = (
    ("reports", "Health reports.", lambda counts: counts.reports),
    ("failures", "Position failures that robots reported.", lambda counts: counts.failures),
    ("silent_failures_estimated", "Silent failures, an estimate.", lambda counts: counts.silent_estimated),
    ("unreported_blindness", "Stretches of blindness without a reported failure.", lambda t: t.unreported_blindness),
    ("observed_seconds", "Time that reports cover.", lambda counts: counts.observed_ms / 1e3),
    ("driving_seconds", "Of it driving; a robot-day is 57600 s.", lambda counts: counts.driving_ms / 1e3),
    ("usable_seconds", "Of it with a usable position.", lambda counts: counts.usable_ms / 1e3),
    ("after_first_fix_seconds", "Of it since the run's first fix.", lambda counts: counts.after_fix_ms / 1e3),
    ("localised_seconds", "Of that TRACKING.", lambda counts: counts.localised_ms / 1e3),
    ("frames", "Frames that were worked on.", lambda counts: counts.frames),
    ("frames_dropped", "Frames that were not.", lambda counts: counts.frames_dropped),
    ("docks", "Arrivals at docks.", lambda counts: counts.docks),
    ("docks_wrong", "Of them with an estimate more than 0.30 m off.", lambda counts: counts.docks_wrong),
)


class FleetCollector(Collector):
    """Reads the fleet's sums when it is asked. The store forgets what is too old, which Prometheus takes for a restart."""

    def __init__(self, store: MapStore, fleet: Fleet) -> None:
        self._store = store
        self._fleet = fleet

    def collect(self) -> Iterator[Metric]:
        """Sums by site, failures and driving by version, failures by cause, robots by status."""
        totals = self._store.fleet.counters(None, "site")
        for name, words, value in _SITE_SUMS:
            family = CounterMetricFamily(f"fleetmap_site_{name}", words, labels=["site"])
            for (site, _), counts in totals.items():
                family.add_metric([site], value(counts))
            yield family
        yield from self._by_version()
        yield from self._by_cause()
        yield from self._robots()

    def _by_version(self) -> Iterator[Metric]:
        sites = {info.site for info in self._store.sites()}
        kept = {(info.site, str(info.version)) for site in sites for info in self._store.versions(site)}
        found = {key: counts for key, counts in self._store.fleet.counters(None, "version").items() if key in kept}
        failures = CounterMetricFamily(
            "fleetmap_version_failures", "Failures on a version.", labels=["site", "version"]
        )
        silent = CounterMetricFamily(
            "fleetmap_version_silent_failures_estimated", "Silent failures, an estimate.", labels=["site", "version"]
        )
        driving = CounterMetricFamily(
            "fleetmap_version_driving_seconds", "Driving with a version.", labels=["site", "version"]
        )
        for key, counts in found.items():
            failures.add_metric(key, counts.failures)
            silent.add_metric(key, counts.silent_estimated)
            driving.add_metric(key, counts.driving_ms / 1e3)
        running = GaugeMetricFamily(
            "fleetmap_site_canary_version", "Version that some robots try, 0 for none.", labels=["site"]
        )
        tried = {row.site: row.version for row in self._store.canaries(running=True)}
        for site in sorted(sites):
            running.add_metric([site], tried.get(site, 0))
        yield from (failures, silent, driving, running)

    def _by_cause(self) -> Iterator[Metric]:
        family = CounterMetricFamily("fleetmap_site_cause_failures", "Failures by cause.", labels=["site", "cause"])
        for key, counts in self._store.fleet.counters(None, "cause").items():
            family.add_metric(key, counts.failures + counts.suspected)
        yield family

    def _robots(self) -> Iterator[Metric]:
        robots = self._fleet.robots()
        present = GaugeMetricFamily("fleetmap_site_robots_present", "Robots on the bus now.", labels=["site"])
        statuses = GaugeMetricFamily(
            "fleetmap_site_robots_status", "Robots heard in the last minute.", labels=["site", "status"]
        )
        skew = GaugeMetricFamily(
            "fleetmap_site_clock_skew_max_seconds", "The most that a robot's clock is wrong.", labels=["site"]
        )
        for info in self._store.sites():
            own = [robot for robot in robots if robot.site == info.site]
            present.add_metric([info.site], sum(robot.is_present is True for robot in own))
            skew.add_metric([info.site], max((abs(robot.clock_ahead_s or 0.0) for robot in own), default=0.0))
            counts = Counter(_status(robot) for robot in own if robot.seconds_since <= _SILENT_AFTER_S)
            for status in (*Status, "other"):
                statuses.add_metric([info.site, status], counts[status])
        yield from (present, statuses, skew)


def _status(robot: RobotStatus) -> str:
    told = (robot.last_health or {}).get("status")
    return told if told in tuple(Status) else "other"
