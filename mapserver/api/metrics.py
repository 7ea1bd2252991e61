"""Prometheus metrics of the server.

Label values come from fixed sets or are names of sites, versions and areas in the store, causes (a few dozen at most), statuses, and
those of the twenty robots of a site that are lost for longest.
"""

from collections import Counter as Counts
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from typing import TypeVar

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from fleetmap.errors import FleetmapError, StateError, StoreError, UsageError
from fleetmap.messages import Flag, Status
from mapserver.fleet.alerts import AlertSettings, lost_since_ns
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.kpis import Counters
from mapserver.fleet_statistics.robot_calibration import PARAMETERS, calibration_figures
from mapserver.floor_plan.areas import OUTSIDE
from mapserver.serving.server_health import HTTP
from mapserver.store import MapStore
from mapserver.trust.http_certificate import HttpCertificate
from mapserver.trust.status import trust_status

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SEEN_WITHIN_S = 60.0
_BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0)
Family = TypeVar("Family", CounterMetricFamily, GaugeMetricFamily)

# Counters: name of the metric, help, and column.
_SITE_SUMS = (
    ("reports", "Health reports.", "reports"),
    ("failures", "Position failures that robots reported.", "failures"),
    ("silent_failures_estimated", "Silent failures, an estimate.", "silent_estimated"),
    ("unreported_blindness", "Stretches of blindness without a reported failure.", "unreported_blindness"),
    ("observed_seconds", "Time that reports cover.", "observed_ms"),
    ("driving_seconds", "Driving time; a robot-day is 57600 s.", "driving_ms"),
    ("driving_judged_seconds", "Driving time, including unknown speed.", "judged_ms"),
    ("driving_localised_seconds", "Of that localised.", "found_ms"),
    ("usable_seconds", "Driving time with a usable position.", "usable_ms"),
    ("after_first_fix_seconds", "Of it since the run's first fix.", "after_fix_ms"),
    ("localised_seconds", "Of that TRACKING.", "localised_ms"),
    ("frames", "Received frames.", "frames"),
    ("frames_dropped", "Of them dropped, by robots that are too slow.", "frames_dropped"),
    ("docks", "Arrivals at docks.", "docks"),
    ("docks_wrong", "Of them with an estimate more than 0.30 m off.", "docks_wrong"),
)
_VERSION_SUMS = (
    ("failures", "Failures on a version.", "failures"),
    ("silent_failures_estimated", "Silent failures, an estimate.", "silent_estimated"),
    ("driving_seconds", "Driving with a version.", "driving_ms"),
)
_AREA_SUMS = (
    ("failures", "Failures in a named area.", "failures"),
    ("driving_seconds", "Driving in a named area.", "driving_ms"),
    ("driving_localised_seconds", "Of that localised.", "found_ms"),
)
_ROBOTS = {
    "robots": "Robots that ever reported.",
    "robots_seen": "Robots that reported in the last minute.",
    "robots_current": "Robots on the wanted version.",
    "robots_present": "Robots on the bus now.",
    "robots_copied": "Robots of which two were there at once within the last hour.",
    "robots_overloaded": "Robots seen in the last minute that drop a tenth of their frames or more.",
    "robots_lost": "Robots that have not known their position for longer than [alerts] lost_s.",
    "clock_skew_max_seconds": "Largest clock error of a robot.",
    "map_word_hours_max": "Age of the oldest map approval on a robot seen in the last minute.",
}
_LOST_WORDS = "Time since such a robot lost its position, of those of a site that are lost for longest."
_MOST_LOST = 20  # of a site: each is a series of its own
_USUAL_ALERTS = AlertSettings()


class Metrics:
    """Counters of one server, in a registry of their own."""

    def __init__(
        self,
        store: MapStore,
        fleet: Fleet,
        alerts: AlertSettings = _USUAL_ALERTS,
        certificate: HttpCertificate | None = None,
    ) -> None:
        own = self._registry = CollectorRegistry()
        ProcessCollector(registry=own)
        labels = ["method", "route", "status"]
        self._requests = Counter("fleetmap_http_requests_total", "HTTP requests.", labels, registry=own)
        name, words = "fleetmap_http_request_seconds", "Time to answer an HTTP request."
        self._seconds = Histogram(name, words, ["route"], registry=own, buckets=_BUCKETS_S)
        name, words = "fleetmap_bus_messages_total", "Queries and messages on the bus."
        self._bus_messages = Counter(name, words, ["what", "result"], registry=own)
        name, words = "fleetmap_bus_sent_bytes_total", "Bytes sent in answers."
        self._bus_bytes = Counter(name, words, ["what"], registry=own)
        own.register(_FleetCollector(store, fleet, alerts, certificate))

    def count_http(self, method: str, route: str, status: int, seconds_s: float) -> None:
        """Count one HTTP request; `route` is the template, not the path, so paths cannot create new series."""
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(route).observe(seconds_s)

    def count_bus(self, what: str, result: str, sent_bytes: int) -> None:
        self._bus_messages.labels(what, result).inc()
        self._bus_bytes.labels(what).inc(sent_bytes)

    def text(self) -> bytes:
        return generate_latest(self._registry)


class _FleetCollector(Collector):
    """Reads sites, robots and fleet sums at each scrape.

    The store deletes old data; Prometheus treats the decrease as a restart.
    """

    def __init__(
        self, store: MapStore, fleet: Fleet, alerts: AlertSettings, certificate: HttpCertificate | None
    ) -> None:
        self._store, self._fleet, self._alerts, self._certificate = store, fleet, alerts, certificate

    def collect(self) -> Iterator[Metric]:
        """State of sites and robots, sums by site, version and cause."""
        sites, counters = self._store.sites(), self._store.fleet.counters
        current = {(info.site,): info.current_version or 0 for info in sites}
        yield _filled(_gauge("site_current_version", "Current version, 0 for none."), current.items())
        tried = {row.site: row.version for row in self._store.canaries(running=True)}
        trials = [((info.site,), tried.get(info.site, 0)) for info in sites]
        yield _filled(_gauge("site_canary_version", "Version in canary, 0 for none."), trials)
        nights = {info.site: self._store.last_night(info.site) for info in sites}
        failed = [((site,), float(night is not None and night.state == "failed")) for site, night in nights.items()]
        yield _filled(_gauge("site_night_failed", "1 where the last night failed."), failed)
        rolled_back = Counts(row.site for row in self._store.canaries() if row.state == "rolled_back")
        family = CounterMetricFamily("fleetmap_site_canaries_rolled_back", "Versions rolled back.", labels=["site"])
        yield _filled(family, (((info.site,), rolled_back[info.site]) for info in sites))
        yield from self._robots([info.site for info in sites])
        yield from _trust(self._store, self._certificate)
        yield from _disk(self._store)
        totals = [((site,), counts) for (site, _), counts in counters(None, "site").items()]
        yield from _sums("site", _SITE_SUMS, ["site"], totals)
        kept = {(info.site, str(version.version)) for info in sites for version in self._store.versions(info.site)}
        by_version = [(key, counts) for key, counts in counters(None, "version").items() if key in kept]
        yield from _sums("version", _VERSION_SUMS, ["site", "version"], by_version)
        named = {(info.site, name) for info in sites for name in (*self._area_names(info.site), OUTSIDE)}
        by_area = [(key, counts) for key, counts in counters(None, "area").items() if key in named]
        yield from _sums("area", _AREA_SUMS, ["site", "area"], by_area)
        by_cause = counters(None, "cause").items()
        family = CounterMetricFamily("fleetmap_site_cause_failures", "Failures by cause.", labels=["site", "cause"])
        yield _filled(family, ((key, counts.failures + counts.suspected) for key, counts in by_cause))

    def _area_names(self, site: str) -> list[str]:
        try:
            return self._store.areas(site).names
        except FleetmapError:  # areas of a building plan, after the map's alignment was removed
            return []

    def _robots(self, sites: list[str]) -> Iterator[Metric]:
        robots = self._fleet.robots()
        gauges = {name: _gauge(f"site_{name}", words) for name, words in _ROBOTS.items()}
        statuses = _gauge("site_robots_status", "Robots seen in the last minute.", "status")
        lost, now_ns = _gauge("site_robot_lost_seconds", _LOST_WORDS, "robot"), self._store.now_ns()
        drifting = _gauge(
            "site_robots_calibration", "Robots seen in the last minute that drift, by parameter.", "parameter"
        )
        for site in sites:
            own = [robot for robot in robots if robot.site == site]
            seen = [robot for robot in own if robot.seconds_since <= _SEEN_WITHIN_S]
            health = [robot.last_health or {} for robot in seen]
            proofs = [each.get("metrics", {}).get("map_word_hours") for each in health]
            figures = {
                "robots": len(own),
                "robots_seen": len(seen),
                "robots_current": sum(robot.version == robot.wanted_version is not None for robot in own),
                "robots_present": sum(robot.is_present is True for robot in own),
                "robots_copied": sum(robot.is_copied for robot in own),
                "robots_overloaded": sum(Flag.OVERLOADED in each.get("flags", ()) for each in health),
                "clock_skew_max_seconds": max((abs(robot.clock_ahead_s or 0.0) for robot in own), default=0.0),
                "map_word_hours_max": max((hours for hours in proofs if isinstance(hours, int | float)), default=0.0),
            }
            since = [(lost_since_ns(robot, self._alerts, now_ns), robot.robot) for robot in seen]
            longest = sorted((since_ns, name) for since_ns, name in since if since_ns is not None)
            figures["robots_lost"] = len(longest)
            _filled(lost, [((site, name), (now_ns - since_ns) / 1e9) for since_ns, name in longest[:_MOST_LOST]])
            for name, figure in figures.items():
                gauges[name].add_metric([site], figure)
            counts = Counts(each.get("status") for each in health)
            other = len(health) - sum(counts[status] for status in Status)
            _filled(statuses, [((site, status), counts[status]) for status in Status])
            _filled(statuses, [((site, "other"), other)])
            drifts = Counts(f.name for each in health for f in calibration_figures(each) if f.is_drifted)
            _filled(drifting, [((site, name), drifts[name]) for name in PARAMETERS])
        yield from (*gauges.values(), lost, statuses, drifting)


def _disk(store: MapStore) -> Iterator[Metric]:
    """No figures from a disk that does not answer."""
    free = GaugeMetricFamily("fleetmap_store_disk_free_bytes", "Free space of the store's disk.")
    total = GaugeMetricFamily("fleetmap_store_disk_total_bytes", "Size of the store's disk.")
    left = GaugeMetricFamily(
        "fleetmap_store_disk_days_left", "Days until the store's disk is full at its growth of the last days."
    )
    with suppress(StoreError):
        found = store.disk_space()
        if found.days_left is not None:
            left.add_metric([], found.days_left)
        free.add_metric([], found.free_bytes)
        total.add_metric([], found.total_bytes)
    yield from (free, total, left)


def _trust(store: MapStore, http: HttpCertificate | None) -> Iterator[Metric]:
    """Days that certificates and signed lists last; of those of the bus no figures for a store that is not signed."""
    faults = GaugeMetricFamily("fleetmap_trust_faults", "Faults that block new maps for robots, now or soon.")
    days = GaugeMetricFamily("fleetmap_trust_days_left", "Days until a role expires.", labels=["role"])
    words = "Days until a certificate expires."
    certificates = GaugeMetricFamily("fleetmap_certificate_days_left", words, labels=["certificate"])
    if http is not None:
        with suppress(UsageError):  # while its file is replaced
            certificates.add_metric([HTTP], http.days_left())
    try:
        found = trust_status(store)
    except StateError:  # an unsigned store
        pass
    except StoreError:  # unreadable lists
        faults.add_metric([], 1)
    else:
        faults.add_metric([], len(found.faults))
        for role in found.roles:
            if role.days_left is not None:
                days.add_metric([role.role], role.days_left)
        for each in found.certificates:
            certificates.add_metric([each.file], each.days_left)
    yield faults
    yield days
    yield certificates


def _gauge(name: str, words: str, *labels: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"fleetmap_{name}", words, labels=["site", *labels])


def _sums(
    prefix: str,
    sums: Iterable[tuple[str, str, str]],
    labels: list[str],
    counters: Sequence[tuple[tuple[str, ...], Counters]],
) -> Iterator[Metric]:
    for name, words, column in sums:
        family = CounterMetricFamily(f"fleetmap_{prefix}_{name}", words, labels=labels)
        per = 1e3 if column.endswith("_ms") else 1  # seconds
        yield _filled(family, ((key, getattr(counts, column) / per) for key, counts in counters))


def _filled(family: Family, values: Iterable[tuple[tuple[str, ...], float]]) -> Family:
    for labels, value in values:
        family.add_metric(labels, value)
    return family
