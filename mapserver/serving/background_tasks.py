"""Periodic work of the server: announce versions, write counters to the disk, decide canaries."""

import asyncio
import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from fleetmap.errors import BusyError, FleetmapError
from fleetmap.log_lines import LogLimit
from mapserver.drafting.job_lock import end_interrupted
from mapserver.fleet.alerts import HEARD_WITHIN_S, AlertSettings, active_alerts, acts_after, end_absent
from mapserver.fleet.canary_controller import review
from mapserver.fleet.fleet import Fleet
from mapserver.fleet.healing import heal
from mapserver.fleet_statistics.canary_decision import CanarySettings
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.serving.bus_access import BusGuard
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore
from mapserver.trust import update_lists

_LOOK_EVERY_S = 0.2
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class BackgroundTask:
    """A function called every `every_s` seconds."""

    name: str
    every_s: float
    act: Callable[[], object]
    due_s: float = 0.0


def server_tasks(
    store: MapStore, fleet: Fleet, bus_service: BusService, canary: CanarySettings, resurvey: ResurveySettings
) -> list[BackgroundTask]:
    """Return all background tasks of a server."""

    def alone(act: Callable[[], object], name: str) -> Callable[[], object]:
        """Return the act, left out while another server does the same."""

        def acts() -> None:
            with suppress(BusyError), store.locked(f"{name}.lock", waits=False):
                act()

        return acts if store.is_shared else act

    return [
        BackgroundTask("following other servers", 1.0, store.files.follow),
        # Before the announcement: robots accept only versions on the lists.
        BackgroundTask("signing the lists of versions", 1.0, lambda: update_lists(store)),
        BackgroundTask("announcing versions", 1.0, bus_service.announce_changes),
        # A crash loses this much of the counts; failures are written at once.
        BackgroundTask("keeping reports", 2.0, fleet.flush),
        BackgroundTask("looking for robots", 5.0, bus_service.look_for_robots),
        BackgroundTask("removing old reports", 600.0, alone(fleet.prune, "prune")),
        BackgroundTask("measuring the disk", 600.0, store.disk_space),
        BackgroundTask(
            "searching for killed jobs", 20.0, alone(lambda: end_interrupted(store, time.time_ns()), "jobs")
        ),
        BackgroundTask("healing", 600.0, alone(lambda: heal(store, resurvey, time.time_ns()), "healing")),
        BackgroundTask("looking at canaries", 10.0, alone(lambda: review(store, canary, time.time_ns()), "canaries")),
    ]


def alert_tasks(store: MapStore, fleet: Fleet, settings: AlertSettings, receiver: Any) -> list[BackgroundTask]:
    """Return the task that ends incidents of alerts and tells a receiver of alerts and acts (`mapserver.alerts` in `hooks.py`)."""
    begun_s, last = time.monotonic(), max((act.id for act in acts_after(store, 0)), default=0)

    def look() -> None:
        nonlocal last
        now_ns, acts = time.time_ns(), acts_after(store, last)
        last = max((act.id for act in acts), default=last)
        if not store.leads():
            return
        alerts = active_alerts(store, fleet, settings, now_ns)
        if time.monotonic() - begun_s > HEARD_WITHIN_S:
            end_absent(store, alerts)
        if receiver is not None:
            receiver.tell(alerts, acts, now_ns)

    return [BackgroundTask("looking for alerts", 10.0, look)]


def admission_tasks(guard: BusGuard | None, fleet: Fleet) -> list[BackgroundTask]:
    """Return the tasks of bus admission. They run separately, because revoking a stolen robot must not wait for others."""
    if guard is None:
        return []

    def look() -> None:
        guard.look()
        fleet.take_copied(guard.copied)

    return [
        BackgroundTask("admitting robots", 1.0, guard.follow),  # changes in between are combined
        BackgroundTask("checking connections", 5.0, look),
    ]


async def run_background_tasks(tasks: list[BackgroundTask]) -> None:
    """Run them in turn, in a thread, until cancelled. A failed one is tried again at its next time."""
    refusals = LogLimit(_log)  # a lasting fault would fill the log every second
    while True:
        for task in tasks:
            if time.monotonic() < task.due_s:
                continue
            try:
                await asyncio.to_thread(task.act)
            except FleetmapError as error:
                # A briefly busy store must not stop the server; robots also query by themselves.
                refusals.warning(task.name, "%s failed: %s", task.name, error)
            except Exception:
                # An error in one task must not end the others.
                _log.exception("%s failed", task.name)
            task.due_s = time.monotonic() + task.every_s
        await asyncio.sleep(_LOOK_EVERY_S)
