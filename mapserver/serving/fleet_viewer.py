"""A site as Foxglove shows it: the current map, the robots, their failures, and a survey under way."""

import time
from collections.abc import Sequence

import numpy as np

from fleetmap.foxglove import channels
from fleetmap.foxglove.channels import MAP, RobotMark, Shown, SurveyChannels
from fleetmap.foxglove.server import FoxgloveServer
from fleetmap.geometry import Array, rotation_from_quat_wxyz, se3
from fleetmap.live_survey import LiveSurveyState
from mapserver.fleet.exports import failure_messages, map_message
from mapserver.fleet.fleet import Fleet, RobotStatus
from mapserver.serving.live_surveys import SILENT_S, LiveSurveys
from mapserver.store import FailureFilter, MapStore

_FIRST_FAILURES = 20


class FleetViewer:
    """Looks at what the server knows whenever `look` is called: neither the bus nor the robots wait for it."""

    def __init__(self, store: MapStore, fleet: Fleet, surveys: LiveSurveys, site: str, server: FoxgloveServer) -> None:
        self._store, self._fleet, self._surveys, self._site, self._server = store, fleet, surveys, site, server
        self._version: int | None = None
        self._failure: int | None = None  # the newest that was shown
        self._survey = SurveyChannels()
        self._state: LiveSurveyState | None = None

    def look(self) -> None:
        """Shows what is new; StoreErrors of what cannot be read."""
        if self._site not in {info.site for info in self._store.sites()}:
            return  # nothing was built for it yet
        now_ns = time.time_ns()
        current = self._store.current(self._site)
        if current is not None and current.version != self._version:
            self._version = version = current.version
            self._server.show([Shown("/map", now_ns, lambda: map_message(self._store, self._site, version, now_ns))])
        if self._server.wants("/robots") or self._server.wants("/tf"):
            self._show_robots(now_ns)
        self._show_failures()
        survey = self._surveys.of(self._site)
        if survey is not None and survey.state is not self._state:
            self._state = survey.state
            self._server.show(self._survey.shown(survey.state))

    def _show_robots(self, now_ns: int) -> None:
        marks = [mark for status in self._fleet.robots(self._site) if (mark := _mark(status)) is not None]
        joined = [(MAP, mark.name, mark.map_from_base) for mark in marks]
        self._server.show(
            [
                Shown("/robots", now_ns, lambda: channels.robots(now_ns, marks)),
                Shown("/tf", now_ns, lambda: channels.links(now_ns, joined)),
            ]
        )

    def _show_failures(self) -> None:
        rows = self._store.fleet.failures(FailureFilter(site=self._site), limit=_FIRST_FAILURES)
        seen = -1 if self._failure is None else self._failure
        for row in reversed(rows):
            if row.number > seen:
                self._failure = row.number
                found = self._store.fleet.failure(row.number)
                self._server.show(Shown.now(message) for message in failure_messages(self._store, found))


def _mark(status: RobotStatus) -> RobotMark | None:
    """Where a robot said it is; None where it has not, or in numbers that are no place."""
    if status.last_pose is None:
        return None
    position_m, quat_wxyz = _numbers(status.last_pose["position_map_m"]), _numbers(status.last_pose["quat_wxyz"])
    if not np.isfinite(position_m).all() or not 0.99 < np.linalg.norm(quat_wxyz) < 1.01:
        return None
    map_from_base = se3(rotation_from_quat_wxyz(quat_wxyz), position_m)
    return RobotMark(status.robot, map_from_base, status.last_pose["status"], is_silent=status.seconds_since > SILENT_S)


def _numbers(values: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values])
