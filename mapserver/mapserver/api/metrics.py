"""Prometheus metrics of the server. Labels take values from fixed sets, or names of sites, which only builds make."""

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from mapserver.api.fleet_metrics import FleetCollector
from mapserver.fleet.fleet import Fleet
from mapserver.store import MapStore

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SEEN_WITHIN_S = 60.0


class Metrics:
    """Counters of one server, in a registry of their own."""

    def __init__(self, store: MapStore, fleet: Fleet) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        self._requests = Counter(
            "fleetmap_http_requests_total", "HTTP requests.", ["method", "route", "status"], registry=self._registry
        )
        self._seconds = Histogram(
            "fleetmap_http_request_seconds",
            "Time to answer an HTTP request.",
            ["route"],
            registry=self._registry,
            buckets=(0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0),
        )
        self._bus_messages = Counter(
            "fleetmap_bus_messages_total",
            "Questions and messages on the bus.",
            ["what", "result"],
            registry=self._registry,
        )
        self._bus_bytes = Counter(
            "fleetmap_bus_sent_bytes_total", "Bytes sent in answers.", ["what"], registry=self._registry
        )
        self._registry.register(_SiteCollector(store, fleet))
        self._registry.register(FleetCollector(store, fleet))

    def count_http(self, method: str, route: str, status: int, seconds_s: float) -> None:
        """One HTTP request; `route` is the template, not the path, so that paths cannot make new series."""
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(route).observe(seconds_s)

    def count_bus(self, what: str, result: str, sent_bytes: int) -> None:
        """One question or message on the bus."""
        self._bus_messages.labels(what, result).inc()
        self._bus_bytes.labels(what).inc(sent_bytes)

    def text(self) -> bytes:
        """The exposition format."""
        return generate_latest(self._registry)


class _SiteCollector(Collector):
    """Reads the state of sites and robots when it is asked."""

    def __init__(self, store: MapStore, fleet: Fleet) -> None:
        self._store = store
        self._fleet = fleet

    def collect(self) -> Iterator[Metric]:
        """Gauges per site."""
        version = GaugeMetricFamily("fleetmap_site_current_version", "Current version, 0 for none.", labels=["site"])
        known = GaugeMetricFamily("fleetmap_site_robots", "Robots that ever reported.", labels=["site"])
        seen = GaugeMetricFamily(
            "fleetmap_site_robots_seen", "Robots that reported in the last minute.", labels=["site"]
        )
        current = GaugeMetricFamily("fleetmap_site_robots_current", "Robots on the wanted version.", labels=["site"])
        robots = self._fleet.robots()
        for info in self._store.sites():
            own = [robot for robot in robots if robot.site == info.site]
            version.add_metric([info.site], info.current_version or 0)
            known.add_metric([info.site], len(own))
            seen.add_metric([info.site], sum(robot.seconds_since <= _SEEN_WITHIN_S for robot in own))
            current.add_metric([info.site], sum(robot.version == robot.wanted_version is not None for robot in own))
        yield from (version, known, seen, current)
