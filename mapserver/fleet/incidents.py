"""Incidents: what somebody must look after until it is closed. What people did about one is in the log, and its state follows from that."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from mapserver.store import Event, MapStore

_STATES = {"acknowledged": "acknowledged", "handed": "acknowledged", "closed": "closed"}  # reopened and ended: open


@dataclass(frozen=True, slots=True)
class Incident:
    """Something present. name: FleetmapFailureRate, FleetmapRobotLost, FleetmapRobotCopied, FleetmapRobotOverloaded, FleetmapNightFailed,
    FleetmapCanaryRolledBack, FleetmapDiskFills or FleetmapTrustFault of an alert, else failure, recording or draft.

    about: its robot, job, version, failure or file, empty for a site as a whole; since_ns: start, nanoseconds since 1970, now if it is
    unknown. state: open, acknowledged or closed; assignee: who has it, empty for nobody; acts: what people did, oldest first.
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
