"""Reports of a replay to the map server: acknowledgement, poses and health, thinned by sensor time, and every failure."""

import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from fleetmap.errors import FleetmapError, LinkError
from fleetmap.messages import encode_message
from locclient.delivery.failure_file import PICTURES
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.delivery.report_delivery import ReplayQueue, deliver, deliver_replay_part
from locclient.maps.connection import MapConnection, replay_outbox
from locclient.maps.map_client import MapClient
from locclient.replay.run_metrics import METRICS
from locclient.replay.run_result import ReplayResult
from locclient.robot.failure_report import RobotProfile, failure_report
from locclient.robot.health_report import Figure, HealthFigures
from locclient.robot.robot import FailureContext, Outcome

_HEALTH_EVERY_NS, _POSE_EVERY_NS = 1_000_000_000, 500_000_000

_OUTBOX_BYTES = 50_000_000
_DELIVERY_S, _RETRY_S = 10.0, 0.5  # at the end of a replay, for reports that wait


class RunReporter:
    """Sends reports while a replay goes on; a connection that breaks is noted once and does not stop the replay.

    Failures go the way of `locclient run`: into the outbox, and from there to the server until it has acknowledged them. What it has not
    when the replay ends is delivered by the robot's next run.
    """

    def __init__(self, connection: MapConnection, result: ReplayResult, profile: RobotProfile) -> None:
        self._connection, self._result, self._profile = connection, result, profile
        self._outbox: Outbox | None = None
        self._replays: ReplayQueue | None = None
        self._replayed_bytes: dict[str, int] = {}
        self.figures = HealthFigures()
        self._health_ns = self._pose_ns = -(2**62)
        self._broken = False
        refused = "; ".join(f"tile {x},{y}: {reason}" for (x, y), reason in result.tiles.refused.items())
        self._send(lambda to: to.ack(result.manifest.version, stamp_ns=time.time_ns(), refused=refused))

    def handle(self, outcome: Outcome) -> None:
        """Sends what is due after a frame, which stands in the result already."""
        self.figures.handle(outcome)
        self._result.notes.extend(words for words in outcome.left_out.values() if words not in self._result.notes)
        if outcome.failure is not None:
            self.figures.count_failure()
            self._report_failure(outcome.failure)
        if self._replays is not None:
            self._replays.work()
        stamp_ns = outcome.estimate.stamp_ns
        message = outcome.pose_message()
        if message is not None and stamp_ns - self._pose_ns >= _POSE_EVERY_NS:
            self._pose_ns = stamp_ns
            self._send(lambda to: to.publish_pose(message))
        if stamp_ns - self._health_ns >= _HEALTH_EVERY_NS:
            self._health_ns = stamp_ns
            self._publish_health()

    def finish(self) -> None:
        """Sends the last report, with the figures of the whole run, and waits a while for the acknowledgement of failures."""
        if self._result.estimates:
            self._publish_health()
        path, until_s = self._connection.outbox, time.monotonic() + _DELIVERY_S
        if self._replays is not None:
            self._replays.work()
        if path is not None and (self._outbox is not None or path.exists()):
            while self._deliver(path) and time.monotonic() < until_s:
                time.sleep(_RETRY_S)
        if self._connection.client is not None and self._replays is not None:
            replays = self._replays.outbox
            while time.monotonic() < until_s and deliver_replay_part(
                self._connection.client, replays, self._replayed_bytes
            ):
                pass
        waiting = self._result.failure_reports["waiting"]
        if waiting:
            self._result.notes.append(f"{waiting} reports of failures wait in {path} for the server")

    def _report_failure(self, context: FailureContext) -> None:
        counts, path = self._result.failure_reports, self._connection.outbox
        counts["detected"] += 1
        if self._connection.client is None or path is None:
            return
        began_ns = time.time_ns() - int(context.failure.duration_s * 1e9)
        report = failure_report(context, self._profile, report_id=uuid.uuid4().hex, wall_ns=began_ns)
        try:
            self._open(path).put(QueuedReport(report.id, encode_message(report)))
            if self._replays is None:
                outbox = Outbox(replay_outbox(path), max_bytes=_OUTBOX_BYTES)
                self._replays = ReplayQueue(outbox, self._profile, PICTURES[0])
            self._replays.add(report, context.cut)
        except FleetmapError as error:
            self._result.notes.append(f"the report of a failure is lost: {error}")
            return
        self._deliver(path)

    def _open(self, path: Path) -> Outbox:
        self._outbox = self._outbox or Outbox(path, max_bytes=_OUTBOX_BYTES)
        return self._outbox

    def _deliver(self, path: Path) -> bool:
        """Whether reports still wait after an attempt to send them, those of earlier runs among them."""
        counts = self._result.failure_reports
        assert self._connection.client is not None
        try:
            outbox = self._open(path)
            before = outbox.counts()["delivered"]
            with suppress(LinkError):  # they wait
                deliver(self._connection.client, outbox)
            after = outbox.counts()
        except FleetmapError as error:
            self._result.notes.append(f"reports of failures are not sent: {error}")
            return False
        counts["delivered"] += after["delivered"] - before
        counts["waiting"] = after["waiting"]
        return after["waiting"] > 0

    def _publish_health(self) -> None:
        """As `locclient run`, and with the errors where there is a ground truth."""
        client, result = self._connection.client, self._result
        if client is None or self._broken:
            return
        more: dict[str, Figure] = {
            "frames": len(result.frames),
            "frames_dropped": 0,
            "tiles_held": len(result.tiles.tiles),
            "tiles_refused": len(result.tiles.refused),
            "map_word_hours": client.word_hours,
        }
        errors = METRICS["error_m"](result.frames)
        if isinstance(errors, dict):
            more |= {f"error_m_{name}": value for name, value in errors.items()}
        site, robot = self._connection.site, self._connection.robot
        # Without a wall clock: the server then measures durations by the recording's stamps, however fast it is played.
        health = self.figures.report(site, robot, None, more, silent=False)
        self._send(lambda to: to.publish_health(health))

    def _send(self, act: Callable[[MapClient], None]) -> None:
        if self._connection.client is None or self._broken:
            return
        try:
            act(self._connection.client)
        except LinkError as error:
            self._broken = True
            self._result.notes.append(f"reports are no longer sent: {error}")
