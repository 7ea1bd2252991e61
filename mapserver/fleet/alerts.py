"""Alerts for operators: robots fail too often, one stays lost, a nightly run failed, a version was rolled back."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated

import msgspec

from fleetmap.config import Section
from fleetmap.errors import StateError
from fleetmap.messages import Status
from mapserver.fleet.fleet import Fleet, RobotStatus
from mapserver.fleet_statistics.kpis import HOUR_NS, Counters, figure, hour_of, kpis
from mapserver.store import MapStore

_HEARD_WITHIN_S = 60.0
_RATE_HOURS = 24
_TOLD_NS = 24 * HOUR_NS  # duration of the alert for a rolled back version
_LOST = {Status.LOST, Status.AMBIGUOUS, Status.INITIALISING}
Positive = Annotated[float, msgspec.Meta(gt=0)]


class AlertSettings(Section, frozen=True):
    """webhook: notified address, None for none; token_file: its content is sent as bearer token.

    failures_per_robot_day: limit for the rate of the last 24 h, exceeded with 97.5 % confidence; lost_s: limit for the time that a robot
    does not know its position.
    """

    webhook: str | None = None
    token_file: str | None = None
    failures_per_robot_day: Positive = 5.0
    lost_s: Positive = 300.0


@dataclass(frozen=True, slots=True)
class Alert:
    """A present condition. name: FleetmapFailureRate, FleetmapRobotLost, FleetmapRobotCopied, FleetmapNightFailed,
    FleetmapCanaryRolledBack or FleetmapTrustFault.

    about: its robot, job or version, empty for a site as a whole; since_ns: start, nanoseconds since 1970.
    """

    name: str
    site: str
    about: str
    since_ns: int
    words: str

    @property
    def key(self) -> tuple[str, str, str]:
        return self.name, self.site, self.about


def active_alerts(store: MapStore, fleet: Fleet, settings: AlertSettings, now_ns: int) -> list[Alert]:
    """Return all active alerts, by site, then faults of lists and certificates; errors are the store's."""
    from mapserver.trust.status import (
        trust_status,
    )  # imported late: it needs zenoh, and builds, which read the settings, do not

    found = [alert for info in store.sites() for alert in _of_site(store, fleet, settings, info.site, now_ns)]
    with suppress(StateError):  # an unsigned store
        found += [
            Alert("FleetmapTrustFault", "", fault.partition(":")[0], now_ns, fault)
            for fault in trust_status(store).faults
        ]
    return found


def _of_site(store: MapStore, fleet: Fleet, settings: AlertSettings, site: str, now_ns: int) -> Iterator[Alert]:
    yield from _failure_rate(store, settings, site, now_ns)
    for robot in fleet.robots(site):
        yield from _lost(robot, settings, now_ns)
        if robot.is_copied:
            ends = f"`mapserver robots revoke {robot.robot} --site {site}` stops the copy"
            words = f"{robot.robot} of {site} was connected twice; was its certificate copied? {ends}"
            yield Alert("FleetmapRobotCopied", site, robot.robot, now_ns, words)
    night = store.last_night(site)
    if night is not None and night.state == "failed":
        words = f"the night of {site} failed (job {night.id}): {night.message}"
        yield Alert("FleetmapNightFailed", site, f"job {night.id}", now_ns, words)
    for row in store.canaries(site):
        if row.state == "rolled_back" and row.ended_ns is not None and now_ns - row.ended_ns < _TOLD_NS:
            words = f"version {row.version} of {site} was rolled back: {row.outcome}"
            yield Alert("FleetmapCanaryRolledBack", site, f"version {row.version}", row.ended_ns, words)


def _failure_rate(store: MapStore, settings: AlertSettings, site: str, now_ns: int) -> Iterator[Alert]:
    counters = store.fleet.counters(site, "site", since_hour=hour_of(now_ns) + 1 - _RATE_HOURS)
    found = kpis(counters.get((site, ""), Counters())).failures
    if found.low is not None and found.low > settings.failures_per_robot_day:
        assert found.per_robot_day is not None
        assert found.high is not None
        words = (
            f"robots of {site} failed {found.events} times in {_RATE_HOURS} h: {figure(found.per_robot_day)} per robot-day "
            f"({figure(found.low)} to {figure(found.high)}), more than {settings.failures_per_robot_day:g}"
        )
        yield Alert("FleetmapFailureRate", site, "", now_ns, words)


def _lost(robot: RobotStatus, settings: AlertSettings, now_ns: int) -> Iterator[Alert]:
    status = (robot.last_health or {}).get("status")
    since_ns = robot.state_since_ns
    if status not in _LOST or since_ns is None or robot.seconds_since > _HEARD_WITHIN_S:
        return
    if now_ns - since_ns >= settings.lost_s * 1e9:
        minutes = (now_ns - since_ns) / 60e9
        words = f"{robot.robot} of {robot.site} has had no known position for {minutes:.0f} min ({status})"
        yield Alert("FleetmapRobotLost", robot.site, robot.robot, since_ns, words)
