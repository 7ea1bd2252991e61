"""Incidents: what somebody must look after until it is closed, and those that are alerts: robots fail too often, one stays lost, a nightly
run failed, a version was rolled back. What people did about one is in the log, and its state follows from that.
"""

import shlex
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime

from fleetmap.config import Positive, Section
from fleetmap.errors import StateError
from fleetmap.messages import Flag, Status
from mapserver.fleet.fleet import Fleet, RobotStatus
from mapserver.fleet_statistics.kpis import HOUR_NS, TOO_MANY_PER_ROBOT_DAY, Counters, format_rate, hour_of, kpis
from mapserver.store import INCIDENT, Event, MapStore

HEARD_WITHIN_S = 60.0
# Of a large disk less than a tenth is enough for some nights.
_LEAST_FREE_SHARE, _LEAST_FREE_BYTES = 0.1, 50_000_000_000
_RATE_HOURS = 24
_TOLD_NS = 24 * HOUR_NS  # duration of the alert for a rolled back version
_LOST = {Status.LOST: "it is lost", Status.AMBIGUOUS: "several places fit", Status.INITIALISING: "it is starting"}
_STATES = {"acknowledged": "acknowledged", "handed": "acknowledged", "closed": "closed"}  # reopened and ended: open


@dataclass(frozen=True, slots=True)
class Incident:
    """Something present. name: FleetmapFailureRate, FleetmapRobotLost, FleetmapRobotCopied, FleetmapRobotOverloaded, FleetmapNightFailed,
    FleetmapCanaryRolledBack, FleetmapDiskFills or FleetmapTrustFault of an alert, else failure, recording or draft.

    about: its robot, job, version, failure or file, empty for a site as a whole; since_ns: start, of a failure when its report came,
    nanoseconds since 1970, now if it is unknown. state: open, acknowledged or closed; assignee: who has it, empty for nobody; acts: what
    people did, oldest first.
    """

    name: str
    site: str
    about: str
    since_ns: int
    words: str
    id: str = ""
    state: str = "open"
    assignee: str = ""
    acts: list[Event] = field(default_factory=list)

    def __post_init__(self) -> None:
        object.__setattr__(self, "id", "/".join(filter(None, (self.name, self.site, self.about))))


def acts_after(store: MapStore, number: int) -> list[Event]:
    """Return what people did about incidents behind a line of the log."""
    acts = [act for acts in store.incident_acts().values() for act in acts if act.id > number and act.actor]
    return sorted(acts, key=lambda act: act.id)


def with_acts(store: MapStore, found: Iterable[Incident]) -> list[Incident]:
    """Return incidents with their state: whoever acknowledges one has it, until it is handed to somebody else, closed, or ends."""
    known, shown = store.incident_acts(), []
    for one in found:
        state, assignee, acts = "open", "", known.get(one.id, [])
        if one.name in ("failure", "recording"):  # the number of a removed one, or the name, may be given again
            acts = [act for act in acts if act.stamp_ns >= one.since_ns]
        for act in acts:
            done, _, name = act.detail.partition(": ")[0].partition(" to ")
            state = state if done == "commented" else _STATES.get(done, "open")
            taker = name or act.actor
            assignee = "" if state == "open" else taker if done in ("acknowledged", "handed") else assignee
        shown.append(replace(one, state=state, assignee=assignee, acts=acts))
    return shown


class AlertSettings(Section, frozen=True):
    """webhook: notified address, None for none; token_file: its content is sent as bearer token.

    failures_per_robot_day: limit for the rate of the last 24 h, exceeded with 97.5 % confidence after enough driving for a rate; lost_s:
    limit for the time that a robot does not know its position.
    """

    webhook: str | None = None
    token_file: str | None = None
    failures_per_robot_day: Positive = TOO_MANY_PER_ROBOT_DAY
    lost_s: Positive = 300.0


def active_alerts(store: MapStore, fleet: Fleet, settings: AlertSettings, now_ns: int) -> list[Incident]:
    """Return all active alerts, by site, then those of the disk, lists and certificates; errors are the store's."""
    from mapserver.trust.status import trust_status  # late: it needs zenoh, and builds, which read the settings, do not

    found = [alert for info in store.sites() for alert in _of_site(store, fleet, settings, info.site, now_ns)]
    disk = store.disk_space()
    if disk.free_bytes < min(_LEAST_FREE_SHARE * disk.total_bytes, _LEAST_FREE_BYTES):
        words = (
            f"the store's disk is nearly full: {disk.free_bytes / 1e9:.1f} of {disk.total_bytes / 1e9:.0f} GB are free; "
            f"`mapserver gc --store {shlex.quote(str(store.folder))}` removes old versions"
        )
        found.append(Incident("FleetmapDiskFills", "", "", now_ns, words))
    with suppress(StateError):  # an unsigned store
        found += [
            Incident("FleetmapTrustFault", "", fault.partition(":")[0], now_ns, fault)
            for fault in trust_status(store).faults
        ]
    return with_acts(store, found)


def end_absent(store: MapStore, alerts: Iterable[Incident]) -> None:
    """Log the end of alerts that people did something about and that are no more: when one begins anew it is open."""
    present = {alert.id for alert in alerts}
    for incident, acts in store.incident_acts().items():
        if incident.startswith("Fleetmap") and incident not in present and not acts[-1].detail.startswith("ended"):
            store.audit(INCIDENT, f"ended: {incident}", site=acts[-1].site)


def _of_site(store: MapStore, fleet: Fleet, settings: AlertSettings, site: str, now_ns: int) -> Iterator[Incident]:
    counters = store.fleet.counters_of(site, "site", hour_of(now_ns) + 1 - _RATE_HOURS)
    failures = kpis(counters.get("", Counters())).failures
    if failures.low is not None and failures.low > settings.failures_per_robot_day:
        words = (
            f"robots of {site} failed {failures.events} times in {_RATE_HOURS} h: {format_rate(failures)} per robot-day, "
            f"more than {settings.failures_per_robot_day:g}"
        )
        yield Incident("FleetmapFailureRate", site, "", now_ns, words)
    for robot in fleet.robots(site):
        health = robot.last_health or {}
        since_ns = lost_since_ns(robot, settings, now_ns)
        if since_ns is not None:
            words = f"has had no known position for {(now_ns - since_ns) / 60e9:.0f} min: {_LOST[health['status']]}"
            yield Incident("FleetmapRobotLost", site, robot.robot, since_ns, f"{robot.robot} of {site} {words}")
        if Flag.OVERLOADED in health.get("flags", ()) and robot.seconds_since <= HEARD_WITHIN_S:
            words = f"{robot.robot} of {site} is too slow: {dropped_words(health.get('metrics', {}))}"
            yield Incident("FleetmapRobotOverloaded", site, robot.robot, now_ns, words)
        if robot.is_copied:
            ends = f"`mapserver robots revoke {robot.robot} --site {site}` stops the copy"
            words = f"{robot.robot} of {site} is there twice; has another robot its name, or was its certificate copied? {ends}"
            yield Incident("FleetmapRobotCopied", site, robot.robot, now_ns, words)
    night = store.last_night(site)
    if night is not None and night.state == "failed":
        words = f"the night of {site} failed (job {night.id}): {night.message}"
        ended = datetime.fromisoformat(night.finished or night.started)
        yield Incident("FleetmapNightFailed", site, f"job {night.id}", int(ended.timestamp()) * 10**9, words)
    for row in store.canaries(site):
        if row.state == "rolled_back" and row.ended_ns is not None and now_ns - row.ended_ns < _TOLD_NS:
            words = f"version {row.version} of {site} was rolled back: {row.outcome}"
            yield Incident("FleetmapCanaryRolledBack", site, f"version {row.version}", row.ended_ns, words)


def dropped_words(metrics: Mapping[str, object]) -> str:
    """Return how many frames an overloaded robot drops, by the figures of its health."""
    share = metrics.get("frames_dropped_share")
    told = f"{share:.0%}" if isinstance(share, float | int) else "many"
    return f"{told} of its frames are dropped; end other programs on its computer, or lower the frame rate"


def lost_since_ns(robot: RobotStatus, settings: AlertSettings, now_ns: int) -> int | None:
    """Return since when a robot has not known its position, None unless it reports that, and for longer than the limit."""
    status, since_ns = (robot.last_health or {}).get("status"), robot.state_since_ns
    if status not in _LOST or since_ns is None or robot.seconds_since > HEARD_WITHIN_S:
        return None
    return since_ns if now_ns - since_ns >= settings.lost_s * 1e9 else None
