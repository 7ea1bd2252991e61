"""Threads of the daemon: sensors, disk, network, and the calling thread, which localizes.

An error of sensors or localization ends all. What comes from outside, of disk and network, does not: it is logged and tried again.
"""

import logging
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from math import inf
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleetmap.errors import FleetmapError, LinkError, RecordingError, StoreError
from fleetmap.free_memory import give_back_free_memory
from fleetmap.log_lines import LogLimit
from fleetmap.messages import RobotHealth, Status, WantedVersion, encode_message
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import Source
from fleetmap.threads import Jobs, ended_by_threads
from fleetmap.version_grid import UNKNOWN, OccupancyGrid
from locclient.daemon.server_sync import ServerSync
from locclient.daemon.service_manager import ServiceManager
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.delivery.report_delivery import ReplayQueue, write_failure
from locclient.delivery.survey_drives import SurveyDrives
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.loaded_map import Cell, LoadedMap, PositionBound
from locclient.maps.tile_cache import TileCache
from locclient.maps.tile_loader import TileLoader
from locclient.outputs import Publisher
from locclient.robot.failure_report import RobotProfile, failure_report
from locclient.robot.health_report import Figure, HealthFigures
from locclient.robot.robot import FailureContext, Outcome, Robot

_TAKE_S, _IDLE_S = 0.2, 0.1
_HEALTH_EVERY_S, _POSE_EVERY_NS = 1.0, 500_000_000
_SILENT_S = 1.0
_DRAIN_S = 5.0
_DELIVERED_WITHIN_S = 30.0  # after the end of a recording
_MAX_PENDING = 100
_RECEIVED = ("frames", "imu_samples")  # among the counts of the intake; the others count what is lost
_NO_GRID = OccupancyGrid(np.full((1, 1), UNKNOWN, np.int8), 0.05, np.eye(4))  # for planners on a floor without one
_log = logging.getLogger(__name__)


class RuntimeParts(NamedTuple):
    """Parts of a daemon. server: None for a robot that reads a store's folder. first: the version to start with. stop_above_m: protection
    level above which nobody but the map server is told that the robot is TRACKING."""

    profile: RobotProfile
    source: Source
    intake: Intake
    robot: Robot
    tile_loader: TileLoader
    outbox: Outbox
    replays: ReplayQueue | None
    publisher: Publisher
    server: ServerSync | None
    first: WantedVersion | None
    failures_folder: Path | None = None
    drives: SurveyDrives | None = None
    caches: tuple[TileCache, ...] = ()
    building: BuildingMaps | None = None
    stop_above_m: float = inf


class Runtime:
    """Runs until `stop` is called, the source ends and a connected server has its failures, or a thread fails; `run` raises its error."""

    def __init__(self, parts: RuntimeParts, manager: ServiceManager) -> None:
        self._parts, self._manager = parts, manager
        self._robot, self._server, self._publisher = parts.robot, parts.server, parts.publisher
        self._links = () if parts.server is None else parts.server.links
        self._stop, self._ending = threading.Event(), threading.Event()
        # Exchanged between threads: deques and plain values, which need no lock.
        self._bound = PositionBound()
        self._held: list[WantedVersion] = []
        self._loaded: deque[LoadedMap] = deque()
        self._site = ""  # whose map the robot is in
        self._failures: deque[tuple[FailureContext, int]] = deque(maxlen=_MAX_PENDING)
        # Owned by the localizing thread.
        self._figures = HealthFigures()
        self._last_frame_s = time.monotonic()
        self._health_s, self._pose_ns = 0.0, -(2**62)
        self._refusals = LogLimit(_log)
        self._counts: dict[str, int] = {}  # of the intake, when losses were told last
        self._outbox_counts = dict[str, Figure]()
        # Owned by the disk thread.
        self._offers = {} if parts.first is None else {parts.first.manifest_sha256 or "": parts.first}
        self._fetched_again: set[tuple[WantedVersion, str]] = set()
        self._shown_grid: tuple[str, WantedVersion] | None = None  # with its site
        self._refused_tiles: dict[WantedVersion, dict[Cell, str]] = {}

    def stop(self) -> None:
        self._stop.set()
        self._ending.set()

    def run(self) -> None:
        """Localize on the calling thread until the end; then join all threads and write their data to the disk."""
        with ended_by_threads(self.stop):
            works: dict[str, Callable[[], None]] = {"sensors": self._run_sensors, "disk": self._run_disk}
            if self._server is not None:
                works["network"] = partial(self._run_network, self._server)
            threads = {name: threading.Thread(target=work, name=name, daemon=True) for name, work in works.items()}
            for thread in threads.values():
                thread.start()
            for link in self._links:
                link.start()
            self._manager.ready()
            self._last_frame_s = time.monotonic()
            try:
                while not self._stop.is_set() and not self._parts.intake.exhausted:
                    self._step()
            finally:
                self._finish(threads)

    def _finish(self, threads: dict[str, threading.Thread]) -> None:
        self._manager.stopping()
        if self._server is not None:
            self._server.health.append(self._health())  # including the last frames
        self._ending.set()
        for name in ("sensors", "disk"):
            threads[name].join(_DRAIN_S)
        self._queue_failures()
        if self._parts.replays is not None and self._robot.ring is not None:
            self._robot.ring.finish()
            self._parts.replays.work()
        if self._parts.drives is not None:
            self._parts.drives.finish()
        if self._server is not None and self._parts.intake.exhausted:
            self._await_delivery(self._server)
        self.stop()
        for thread in threads.values():
            thread.join(_DRAIN_S)
        for link in self._links:
            link.stop()
        self._tell_losses()
        total = self._health().metrics
        words = "stopped after %s frames and %s failures: %s reports are delivered, %s wait"
        _log.info(words, *(total.get(name) for name in ("frames", "failures", "spool_delivered", "spool_waiting")))
        if words := self._figures.search.words:
            _log.warning("stopped: %s", words)

    def _await_delivery(self, server: ServerSync) -> None:
        """Wait while a connected server takes failures and their recordings. What is left stays in the spool."""
        server.recordings_at_s = 0.0
        spools = [spool for spool in (self._parts.outbox, server.replays) if spool is not None]
        until_s = time.monotonic() + _DELIVERED_WITHIN_S
        with suppress(Exception):  # a faulty spool; logged by the network thread
            while time.monotonic() < until_s and server.client.bus.connected() and any(s.waiting() for s in spools):
                if self._stop.wait(_IDLE_S):
                    return

    # --- the thread that localizes ------------------------------------------------------------------------------------

    def _step(self) -> None:
        robot, server, intake = self._robot, self._server, self._parts.intake
        bundle = intake.take(_TAKE_S)
        while self._loaded:
            robot.use(self._loaded.popleft())
            give_back_free_memory()  # of the previous version and of loading this one; takes 0.5 ms
        while self._parts.building is not None and self._parts.building.changes:
            robot.use_building(*self._parts.building.changes.popleft())
            give_back_free_memory()
        outcome = None
        try:
            outcome = robot.handle(bundle)
            if self._parts.drives is not None:
                self._parts.drives.handle(bundle, None if outcome is None else outcome.estimate)
        except RecordingError as error:
            intake.count_unreadable(str(error))
            _log.warning("a frame is skipped: %s", error)
        now_s = time.monotonic()
        if outcome is not None:
            self._last_frame_s = now_s
            self._after_frame(outcome)
        else:
            silent_s = now_s - self._last_frame_s
            self._note_failure(robot.handle_silence(silent_s), silent_s)
        self._held = [loaded.wanted for loaded in robot.versions.held]
        if server is not None:
            server.changes.extend(robot.versions.changes)
            robot.versions.changes.clear()
        self._report(now_s)

    def _after_frame(self, outcome: Outcome) -> None:
        estimate = outcome.estimate
        self._site = estimate.floor
        said = outcome
        if estimate.status is Status.TRACKING and estimate.protection_m > self._parts.stop_above_m:
            said = replace(outcome, estimate=replace(estimate, status=Status.DEGRADED))
        _send(partial(self._publisher.publish, said.estimate, said.published, self._robot.base_from_body))
        for link in self._links:
            held = frozenset(loaded.version for loaded in self._robot.versions.held)
            visited = {site: loaded.version for site, loaded in self._robot.visited.items()}
            link.after_frame(said, held, self._robot.building, visited)
        was_lost, last = self._figures.search.is_long, self._figures.last
        if last is None or (estimate.status, estimate.floor) != (last.estimate.status, last.estimate.floor):
            _log.info("status %s", estimate.in_words)
        before = {} if last is None else last.left_out
        for flag in outcome.left_out.keys() - before.keys():
            _log.warning("%s", outcome.left_out[flag])
        self._figures.handle(outcome)
        if self._figures.search.is_long != was_lost:
            _log.warning("%s", "localized again" if was_lost else self._figures.search.words)
        self._bound = self._bound.after(estimate, self._parts.tile_loader.settings.most_mps)
        self._note_failure(outcome.failure, 0.0)
        message = outcome.pose_message()
        server = None if self._server is None or self._server.is_alone else self._server
        if server is not None and message is not None and estimate.stamp_ns - self._pose_ns >= _POSE_EVERY_NS:
            self._pose_ns = estimate.stamp_ns
            _send(partial(server.client.publish, "pose", message, may_drop=True))

    def _note_failure(self, context: FailureContext | None, silent_s: float) -> None:
        if context is not None:
            failure = context.failure
            _log.warning("failure: %s, %s, %s", failure.kind, failure.cause, failure.estimate.status.value)
            self._figures.failures += 1
            self._failures.append((context, time.time_ns() - int(max(failure.duration_s, silent_s) * 1e9)))

    def _report(self, now_s: float) -> None:
        if now_s - self._health_s < _HEALTH_EVERY_S:
            return
        self._health_s = now_s
        self._tell_losses()
        is_silent = self._is_silent()
        for link in self._links if is_silent else ():
            link.silence()
        if self._server is not None:
            self._server.health.append(self._health())
        _send(partial(self._publisher.alive, is_silent))
        last = self._figures.last
        status = "no frame yet" if last is None else last.estimate.status.value
        self._manager.alive("no frames come" if is_silent else status)

    def _tell_losses(self) -> None:
        """Log the frames and samples that were lost since the last time."""
        before, self._counts = self._counts, asdict(self._parts.intake.counts)
        new = {name: count - before.get(name, 0) for name, count in self._counts.items() if name not in _RECEIVED}
        if lost := [f"{count} {name.replace('_', ' ')}" for name, count in new.items() if count]:
            _log.info("lost: %s", ", ".join(lost))
        if new["unreadable"]:
            self._refusals.warning("message", "a sensor's message is not used: %s", self._parts.intake.unreadable_why)

    def _is_silent(self) -> bool:
        return time.monotonic() - self._last_frame_s > _SILENT_S

    def _health(self) -> RobotHealth:
        counts: dict[str, Figure] = dict(asdict(self._parts.intake.counts))
        with suppress(StoreError):  # logged by the disk or network thread
            self._outbox_counts = {f"spool_{name}": value for name, value in self._parts.outbox.counts().items()}
        tiles = {
            "tiles_held": sum(len(loaded.tiles) for loaded in self._robot.versions.held),
            "tiles_refused": sum(map(len, self._refused_tiles.values())),
            "cache_faults": sum(cache.faults for cache in self._parts.caches),
        }
        if self._server is not None:
            trust = self._server.client.trust
            counts["map_word_hours"] = None if trust is None else trust.word_hours
        profile, more = self._parts.profile, {**counts, **self._outbox_counts, **tiles}
        return self._figures.report(profile.site, profile.robot, time.time_ns(), more, self._is_silent())

    # --- the other threads --------------------------------------------------------------------------------------------

    def _run_sensors(self) -> None:
        try:
            self._parts.source.run(self._parts.intake, self._ending.wait)
        finally:
            self._parts.intake.finish()

    def _run_disk(self) -> None:
        kept = [part.work for part in (self._parts.replays, self._parts.drives) if part is not None]
        jobs = Jobs(self._load_maps, self._queue_failures, *kept)
        while not self._ending.wait(_IDLE_S):
            jobs.work()

    def _load_maps(self) -> None:
        loader, server, bound = self._parts.tile_loader, self._server, self._bound
        while server is not None and server.fetched:
            version = server.fetched.popleft()
            self._shown_grid = None if ("", version) == self._shown_grid else self._shown_grid
            self._offers[version.manifest_sha256 or ""] = version
            loader.retry_refused(version)
        held = self._held
        for version in held:
            self._offers.pop(version.manifest_sha256 or "", None)
        wanted = [*held, *self._offers.values()]
        for version in wanted:
            try:
                loaded = loader.load(version, bound)
            except FleetmapError as error:
                _log.warning("version %s cannot be loaded: %s", version.version, error)
                self._offers.pop(version.manifest_sha256 or "", None)
                self._fetches_again(version)
                continue
            if loaded is not None:
                self._loaded.append(replace(loaded, is_offer=version not in held))
                self._note_refused_tiles(version, loaded.refused)
        if held:
            self._show_grid(held[0])
        loader.keep_only(wanted)
        self._refused_tiles = {version: cells for version, cells in self._refused_tiles.items() if version in wanted}

    def _show_grid(self, version: WantedVersion) -> None:
        """Publish the grid of the map in which the robot is: of the confirmed version, or of another site's. If an older client did not
        fetch it with the version, fetch it now, once."""
        publisher, site, building = self._publisher, self._site, self._parts.building
        if site and building is not None:
            version = building.held.get(site, version)
        if publisher.grid_height_m is None or (site, version) == self._shown_grid:
            return
        was_elsewhere = self._shown_grid is not None and self._shown_grid[0] != site
        self._shown_grid, grid, why = (site, version), None, ""
        try:
            grid = self._parts.tile_loader.grid(version, publisher.grid_height_m)
        except FleetmapError as error:
            why = str(error)
            if was_elsewhere:  # a planner must not use the grid of where the robot was
                _send(partial(publisher.show_grid, version.version or 0, _NO_GRID, ""))
            if not site and isinstance(error, LinkError) and self._fetches_again(version, "grid"):
                return
        _send(partial(publisher.show_grid, version.version or 0, grid, why))

    def _fetches_again(self, version: WantedVersion, piece: str = "") -> bool:
        """Fetch a version again for a missing piece, once for each; False without a server, or if that did not help."""
        if self._server is None or (version, piece) in self._fetched_again:
            return False
        self._fetched_again.add((version, piece))
        self._server.refetch.append(version)
        return True

    def _note_refused_tiles(self, version: WantedVersion, refused: dict[Cell, str]) -> None:
        """Log refused tiles once, and request them again."""
        if refused == self._refused_tiles.get(version, {}):
            return
        self._refused_tiles[version] = refused
        for cell, reason in refused.items():
            _log.warning("tile %s of version %s is refused: %s", cell, version.version, reason)
        if refused and self._server is not None:
            self._server.refetch.append(version)

    def _queue_failures(self) -> None:
        parts = self._parts
        while self._failures:
            context, wall_ns = self._failures.popleft()
            report = failure_report(context, parts.profile, report_id=uuid.uuid4().hex, wall_ns=wall_ns)
            try:
                parts.outbox.put(QueuedReport(report.id, encode_message(report)))
                if parts.replays is not None:
                    parts.replays.add(report, context.cut)
                if parts.failures_folder is not None:
                    write_failure(parts.failures_folder, report)
            except FleetmapError as error:
                _log.error("failure %s is lost: %s", report.id, error)

    def _run_network(self, server: ServerSync) -> None:
        jobs = Jobs(server.step, *(link.work for link in server.links))
        while not self._stop.wait(_IDLE_S):
            jobs.work()
        jobs.work()  # a last time: delivers the last version changes and failures if the server is reachable
        server.close()


def _send(publish: Callable[[], None]) -> None:
    try:
        publish()
    except FleetmapError as error:
        _log.warning("the robot's own programs or the server missed a message: %s", error)
