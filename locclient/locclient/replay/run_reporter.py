"""Reports of a replay to the map server: acknowledgement, poses and health, thinned by sensor time."""

import time
from collections.abc import Callable

from fleetmap.errors import LinkError
from fleetmap.messages import OFF_MAP, RobotHealth
from locclient.maps.connection import MapConnection
from locclient.maps.map_client import MapClient
from locclient.replay.run_metrics import METRICS
from locclient.replay.run_result import ReplayResult
from locclient.robot.health_report import FixFigures
from locclient.robot.robot import Outcome

_HEALTH_EVERY_NS, _POSE_EVERY_NS = 1_000_000_000, 500_000_000


class RunReporter:
    """Sends reports while a replay goes on; a connection that breaks is noted once and does not stop the replay."""

    def __init__(self, connection: MapConnection, result: ReplayResult) -> None:
        self._connection, self._result = connection, result
        self._fixes = FixFigures()
        self._health_ns = self._pose_ns = -(2**62)
        self._broken = False
        refused = "; ".join(f"tile {x},{y}: {reason}" for (x, y), reason in result.tiles.refused.items())
        self._send(lambda to: to.ack(result.manifest.version, stamp_ns=time.time_ns(), refused=refused))

    def handle(self, outcome: Outcome) -> None:
        """Sends what is due after a frame, which stands in the result already."""
        self._fixes.handle(outcome.estimate, outcome.dock_error_m)
        stamp_ns = outcome.estimate.stamp_ns
        message = outcome.pose_message()
        if message is not None and stamp_ns - self._pose_ns >= _POSE_EVERY_NS:
            self._pose_ns = stamp_ns
            self._send(lambda to: to.publish_pose(message))
        if stamp_ns - self._health_ns >= _HEALTH_EVERY_NS:
            self._health_ns = stamp_ns
            self._publish_health()

    def finish(self) -> None:
        """Sends the last report, with the figures of the whole run."""
        if self._result.estimates:
            self._publish_health()

    def _publish_health(self) -> None:
        if self._connection.client is None or self._broken:
            return
        result, estimate, mapped = self._result, self._result.estimates[-1], self._result.frames[-1].may_be_mapped
        figures: dict[str, float | int | str | bool | None] = {
            name: value for name, value in result.report.items() if isinstance(value, int | float | str | bool)
        }
        for group in ("error_m", "frame_ms"):
            spread = METRICS[group](result.frames)
            if isinstance(spread, dict):
                figures.update({f"{group}_{name}": value for name, value in spread.items()})
        health = RobotHealth(
            site=self._connection.site,
            robot=self._connection.robot,
            stamp_ns=estimate.stamp_ns,
            version=estimate.map_version,
            status=estimate.status,
            flags=(*(["tiles_refused"] if result.tiles.refused else []), *([] if mapped else [OFF_MAP])),
            metrics=figures | self._fixes.take(),
        )
        self._send(lambda to: to.publish_health(health))

    def _send(self, act: Callable[[MapClient], None]) -> None:
        if self._connection.client is None or self._broken:
            return
        try:
            act(self._connection.client)
        except LinkError as error:
            self._broken = True
            self._result.notes.append(f"reports are no longer sent: {error}")
