"""Prometheus metrics of the server.

Label values come from fixed sets or are names of sites, versions and areas in the store, causes (a few dozen at most), statuses, and
those of the twenty robots of a site that are lost for longest.
"""

from collections import Counter as Counts
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from fleetmap.errors import FleetmapError, StateError, StoreError, UsageError
from fleetmap.messages import Flag, Status
from mapserver.fleet.alerts import AlertSettings, lost_since_ns
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.robot_calibration import PARAMETERS, calibration_figures
from mapserver.floor_plan.areas import OUTSIDE
from mapserver.serving.server_health import HTTP
from mapserver.store import MapStore, SiteInfo
from mapserver.trust.http_certificate import HttpCertificate
from mapserver.trust.status import trust_status

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SEEN_WITHIN_S = 60.0
_BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0)

# Counters by axis: name of the metric, help, and column.
_SUMS = {
    "site": (
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
    ),
    "version": (
        ("failures", "Failures on a version.", "failures"),
        ("silent_failures_estimated", "Silent failures, an estimate.", "silent_estimated"),
        ("driving_seconds", "Driving with a version.", "driving_ms"),
    ),
    "area": (
        ("failures", "Failures in a named area.", "failures"),
        ("driving_seconds", "Driving in a named area.", "driving_ms"),
        ("driving_localised_seconds", "Of that localised.", "found_ms"),
    ),
}
# Gauges, of a site or of the server: name of the metric, and help.
_GAUGES = {
    "site_current_version": "Current version, 0 for none.",
    "site_canary_version": "Version in canary, 0 for none.",
    "site_night_failed": "1 where the last night failed.",
    "site_robots": "Robots that ever reported.",
    "site_robots_seen": "Robots that reported in the last minute.",
    "site_robots_current": "Robots on the wanted version.",
    "site_robots_present": "Robots on the bus now.",
    "site_robots_copied": "Robots of which two were there at once within the last hour.",
    "site_robots_overloaded": "Robots seen in the last minute that drop a tenth of their frames or more.",
    "site_robots_lost": "Robots that have not known their position for longer than [alerts] lost_s.",
    "site_robots_status": "Robots seen in the last minute.",
    "site_robots_calibration": "Robots seen in the last minute that drift, by parameter.",
    "site_robot_lost_seconds": "Time since such a robot lost its position, of those of a site that are lost for longest.",
    "site_clock_skew_max_seconds": "Largest clock error of a robot.",
    "site_map_word_hours_max": "Age of the oldest map approval on a robot seen in the last minute.",
    "trust_faults": "Faults that block new maps for robots, now or soon.",
    "trust_days_left": "Days until a role expires.",
    "certificate_days_left": "Days until a certificate expires.",
    "store_disk_free_bytes": "Free space of the store's disk.",
    "store_disk_total_bytes": "Size of the store's disk.",
    "store_disk_days_left": "Days until the store's disk is full at its growth of the last days.",
}
_COUNTERS = {
    "site_canaries_rolled_back": "Versions rolled back.",
    "site_cause_failures": "Failures by cause.",
    **{f"{axis}_{name}": words for axis, sums in _SUMS.items() for name, words, _ in sums},
}
_MOST_LOST = 20  # of a site: each is a series of its own
_USUAL_ALERTS = AlertSettings()
Figure = tuple[str, float, dict[str, str]]
"""Name, value and labels of a metric."""


class Metrics(Collector):
    """Counters of one server, in a registry of their own, and what it reads of sites, robots and fleet sums at each scrape.

    The store deletes old data; Prometheus treats the decrease as a restart.
    """

    def __init__(
        self,
        store: MapStore,
        fleet: Fleet,
        alerts: AlertSettings = _USUAL_ALERTS,
        certificate: HttpCertificate | None = None,
    ) -> None:
        self._store, self._fleet, self._alerts, self._certificate = store, fleet, alerts, certificate
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
        own.register(self)

    def count_http(self, method: str, route: str, status: int, seconds_s: float) -> None:
        """Count one HTTP request; `route` is the template, not the path, so paths cannot create new series."""
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(route).observe(seconds_s)

    def count_bus(self, what: str, result: str, sent_bytes: int) -> None:
        self._bus_messages.labels(what, result).inc()
        self._bus_bytes.labels(what).inc(sent_bytes)

    def text(self) -> bytes:
        return generate_latest(self._registry)

    def collect(self) -> list[Metric]:
        """All metrics of the tables, also those without a figure."""
        counters = {name: Metric(f"fleetmap_{name}", words, "counter") for name, words in _COUNTERS.items()}
        gauges = {name: Metric(f"fleetmap_{name}", words, "gauge") for name, words in _GAUGES.items()}
        sites = self._store.sites()
        figures = (*map(self._site, sites), *map(self._robots, sites), self._trust(), self._disk(), self._sums(sites))
        for name, value, labels in chain(*figures):
            metric, ending = (counters[name], "_total") if name in counters else (gauges[name], "")
            metric.add_sample(metric.name + ending, labels, value)
        return [*gauges.values(), *counters.values()]

    def _site(self, info: SiteInfo) -> Iterator[Figure]:
        site, night = {"site": info.site}, self._store.last_night(info.site)
        canaries = self._store.canaries(info.site)
        yield "site_current_version", info.current_version or 0, site
        yield "site_canary_version", next((row.version for row in canaries if row.state == "running"), 0), site
        yield "site_canaries_rolled_back", sum(row.state == "rolled_back" for row in canaries), site
        yield "site_night_failed", night is not None and night.state == "failed", site

    def _robots(self, info: SiteInfo) -> Iterator[Figure]:
        site, now_ns = {"site": info.site}, self._store.now_ns()
        own = self._fleet.robots(info.site)
        seen = [robot for robot in own if robot.seconds_since <= _SEEN_WITHIN_S]
        health = [robot.last_health or {} for robot in seen]
        proofs = [each.get("metrics", {}).get("map_word_hours") for each in health]
        hours = [proof for proof in proofs if isinstance(proof, int | float)]
        since = [(lost_since_ns(robot, self._alerts, now_ns), robot.robot) for robot in seen]
        lost = sorted((since_ns, name) for since_ns, name in since if since_ns is not None)
        yield "site_robots", len(own), site
        yield "site_robots_seen", len(seen), site
        yield "site_robots_current", sum(robot.version == robot.wanted_version is not None for robot in own), site
        yield "site_robots_present", sum(robot.is_present is True for robot in own), site
        yield "site_robots_copied", sum(robot.is_copied for robot in own), site
        yield "site_robots_overloaded", sum(Flag.OVERLOADED in each.get("flags", ()) for each in health), site
        yield "site_clock_skew_max_seconds", max((abs(robot.clock_ahead_s or 0.0) for robot in own), default=0.0), site
        yield "site_map_word_hours_max", max(hours, default=0.0), site
        yield "site_robots_lost", len(lost), site
        for since_ns, name in lost[:_MOST_LOST]:
            yield "site_robot_lost_seconds", (now_ns - since_ns) / 1e9, site | {"robot": name}
        said = (each.get("status") for each in health)
        statuses = Counts(status if status in set(Status) else "other" for status in said)
        for status in (*Status, "other"):
            yield "site_robots_status", statuses[status], site | {"status": status}
        drifts = Counts(f.name for each in health for f in calibration_figures(each) if f.is_drifted)
        for name in PARAMETERS:
            yield "site_robots_calibration", drifts[name], site | {"parameter": name}

    def _sums(self, sites: Sequence[SiteInfo]) -> Iterator[Figure]:
        """Sums of sites, and of the versions and areas that are in the store; failures by cause."""
        versions = {(info.site, str(found.version)) for info in sites for found in self._store.versions(info.site)}
        areas = {(info.site, OUTSIDE) for info in sites}
        for info in sites:
            with suppress(FleetmapError):  # areas of a building plan, after the map's alignment was removed
                areas |= {(info.site, name) for name in self._store.areas(info.site).names}
        for axis, kept in (("site", None), ("version", versions), ("area", areas)):
            for key, counts in self._store.fleet.counters(None, axis).items():
                if kept is None or key in kept:
                    labels = {axis: key[1], "site": key[0]}
                    for name, _, column in _SUMS[axis]:
                        per = 1e3 if column.endswith("_ms") else 1  # seconds
                        yield f"{axis}_{name}", getattr(counts, column) / per, labels
        for (site, cause), counts in self._store.fleet.counters(None, "cause").items():
            yield "site_cause_failures", counts.failures + counts.suspected, {"site": site, "cause": cause}

    def _disk(self) -> Iterator[Figure]:
        """No figures from a disk that does not answer."""
        with suppress(StoreError):
            found = self._store.disk_space()
            if found.days_left is not None:
                yield "store_disk_days_left", found.days_left, {}
            yield "store_disk_free_bytes", found.free_bytes, {}
            yield "store_disk_total_bytes", found.total_bytes, {}

    def _trust(self) -> Iterator[Figure]:
        """Days that certificates and signed lists last; of those of the bus no figures for a store that is not signed."""
        if self._certificate is not None:
            with suppress(UsageError):  # while its file is replaced
                yield "certificate_days_left", self._certificate.days_left(), {"certificate": HTTP}
        try:
            found = trust_status(self._store)
        except StateError:  # an unsigned store
            return
        except StoreError:  # unreadable lists
            yield "trust_faults", 1, {}
            return
        yield "trust_faults", len(found.faults), {}
        for role in found.roles:
            if role.days_left is not None:
                yield "trust_days_left", role.days_left, {"role": role.role}
        for each in found.certificates:
            yield "certificate_days_left", each.days_left, {"certificate": each.file}
