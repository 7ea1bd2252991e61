"""Ingestion of robots' reports: counters by the hour for site, robot, version, tile, cause and arm of a canary."""

import math
import threading
from dataclasses import fields
from typing import Annotated, Any, NamedTuple

import msgspec

from fleetmap.config import Positive, Section
from fleetmap.errors import FleetmapError, UnknownOutcomeError
from fleetmap.messages import FailureKind, FailureReport, PoseMessage, RobotHealth
from mapserver.fleet_statistics.canary_decision import DAY_NS
from mapserver.fleet_statistics.health_stream import HealthStream, server_time_ns
from mapserver.fleet_statistics.kpis import Counters, hour_of
from mapserver.fleet_statistics.robot_calibration import number_of
from mapserver.floor_plan.areas import OUTSIDE, Areas
from mapserver.store import CanaryRow, CounterKey, FleetBatch, FleetRetention, MapStore, TraceRow, tile_key
from mapserver.store.fleet_queries import LastReport

Days = Annotated[float, msgspec.Meta(gt=0, le=36_500)]  # a century: 64 bits of nanoseconds hold three
PositiveInt = Annotated[int, msgspec.Meta(ge=1)]
_CANARIES_KEPT_NS = _AREAS_KEPT_NS = 1_000_000_000
_LEAST_BETWEEN_TRACES_NS = 900_000_000
_TRACE_STEP_M = 0.5
_TRACED = {"radius_95_m": "radius_95_m", "frame_ms": "frame_ms_mean", "exposure": "exposure", "sharpness": "sharpness"}
_MAX_CAUSES = 64
_MAX_KEPT_TRACES = 200_000


class IngestSettings(Section, frozen=True):
    """Rate of the robots' stored traces, and retention of what robots and surveys send: reports, pictures, recordings.

    trace_every_s: of a robot that stands. One that drives gets a row each half metre, with a longer step as it uses up as many rows a
    day as standing gives.
    """

    trace_every_s: Positive = 10.0
    trace_days: Days = 2.0
    tally_days: Days = 400.0
    failure_days: Days = 400.0
    picture_days: Days = 30.0
    replay_days: Days = 30.0
    survey_picture_days: Days = 400.0
    recording_days: Days = 400.0
    picture_bytes: PositiveInt = 1_000_000_000  # above, the oldest pictures are deleted
    replay_bytes: PositiveInt = 2_000_000_000  # above, the oldest recordings are deleted

    def retention(self) -> FleetRetention:
        return FleetRetention(
            **{f.name: getattr(self, f.name) for f in fields(FleetRetention) if hasattr(self, f.name)}
        )


class Stream(msgspec.Struct):
    """What is counted from of one robot's messages. For one thread at a time."""

    health: HealthStream = msgspec.field(default_factory=HealthStream)
    trace_ns: int = -(1 << 62)
    trace_map_m: tuple[float, float] | None = None
    rows_left: float = math.inf  # until it is first bounded by the rows of a day
    status: str = ""
    hour: int | None = None


class _Grid(NamedTuple):
    """Tiles of one version."""

    size_m: float
    cells: frozenset[tuple[int, int]]

    def key(self, x_m: float, y_m: float) -> str:
        if not (math.isfinite(x_m) and math.isfinite(y_m)):
            return OUTSIDE
        return self.cell_key((math.floor(x_m / self.size_m), math.floor(y_m / self.size_m)))

    def cell_key(self, cell: tuple[int, int]) -> str:
        """Key of a tile, if the version has it: robots cannot invent keys."""
        return (tile_key(cell) or OUTSIDE) if cell in self.cells else OUTSIDE


class Ingest:
    """Counts in memory until `flush` writes to the disk; failures are written at once. Methods may be called from any thread."""

    def __init__(self, store: MapStore, settings: IngestSettings) -> None:
        self._store = store
        self._settings = settings
        self._lock = threading.Lock()
        self._flushing = threading.Lock()
        self._batch = FleetBatch()
        self._grids: dict[tuple[str, int], _Grid | None] = {}
        self._canaries: dict[str, CanaryRow] = {}
        self._canaries_ns = -(1 << 62)
        self._areas: dict[str, tuple[int, Areas]] = {}
        self._causes: dict[str, set[str]] = {}

    def take_health(self, stream: Stream, health: RobotHealth, estimate: PoseMessage | None, last: LastReport) -> None:
        """Count a report. last: what the store shows of the robot."""
        site, robot, now_ns = health.site, health.robot, last[1]
        hour = hour_of(now_ns)
        grid = self._grid(site, health.version)
        canary, areas = self._canary(site, now_ns), self._areas_of(site, now_ns)
        with self._lock:
            is_continued = stream.health.in_failure and stream.hour is not None and hour > stream.hour
            counts = stream.health.take_health(health)
            stream.hour = hour
            self._batch.last_reports[site, robot] = last
            if counts is None:
                return
            counts.continued = int(is_continued)
            place = None if estimate is None or estimate.map_version != health.version else estimate.position_map_m
            for axis, key in _keys(robot, health.version, grid, _arm(canary, health.version)):
                self._batch.add(site, axis, key, hour, counts)
            if grid is not None and place is not None:
                self._batch.add(site, "tile", grid.key(place[0], place[1]), hour, counts)
                if areas:
                    self._batch.add(site, "area", areas.at(place[0], place[1]) or OUTSIDE, hour, counts)
            if self._is_trace_due(stream, health, place, now_ns):
                self._batch.traces.append(_trace(health, place, now_ns))

    def take_failure(self, report: FailureReport, now_ns: int, ahead_s: float | None) -> bool:
        """Write a failure with its sums; False for a duplicate. Raises StoreError."""
        oldest_ns = now_ns - int(self._settings.failure_days * DAY_NS)
        happened_ns = server_time_ns(report.wall_ns, ahead_s, now_ns, oldest_ns)
        grid = self._grid(report.site, report.version)
        canary = self._canary(report.site, now_ns)
        arm = _arm(canary, report.version) if canary is not None and happened_ns >= canary.started_ns else None
        counts = Counters(suspected=1) if report.kind == FailureKind.SUSPECTED else Counters(failures=1)
        counts.blind_failures = int(report.kind in {FailureKind.BLIND, FailureKind.NOT_FOUND})
        keys = _keys(report.robot, report.version, grid, arm)
        keys.append(("cause", self._cause(report.site, report.cause)))
        if grid is not None and report.tile is not None:
            keys.append(("tile", grid.cell_key(report.tile)))
        areas, area = self._areas_of(report.site, now_ns), None
        if areas and grid is not None and report.map_from_base is not None:
            area = areas.at(*report.map_from_base.position_m[:2])
            keys.append(("area", area or OUTSIDE))
        counters: dict[CounterKey, Counters] = {(report.site, *key, hour_of(happened_ns)): counts for key in keys}
        times_ns = (now_ns, happened_ns)
        return self._store.fleet.add_failure(report, times_ns, counters, self._settings.retention(), area)

    def has_counted(self) -> bool:
        with self._lock:
            return bool(self._batch.counters or self._batch.last_reports)

    def flush(self) -> None:
        """Write the counts to the disk. On error raises StoreError and keeps them for the next call, unless the store may have them:
        what is rather lost than counted twice are those since the last call.
        """
        with self._flushing:
            with self._lock:
                batch, self._batch = self._batch, FleetBatch()
            try:
                self._store.fleet.add(batch)
            except UnknownOutcomeError:
                raise
            except FleetmapError:
                with self._lock:
                    newer, self._batch = self._batch, batch
                    for (site, axis, key, hour), counts in newer.counters.items():
                        batch.add(site, axis, key, hour, counts)
                    batch.last_reports |= newer.last_reports
                    batch.traces = [*batch.traces, *newer.traces][-_MAX_KEPT_TRACES:]
                raise

    def prune(self) -> int:
        """Remove old or excess data from the store; return the number of removed rows."""
        return self._store.fleet.prune(self._settings.retention())

    def _is_trace_due(
        self, stream: Stream, health: RobotHealth, place: tuple[float, float, float] | None, now_ns: int
    ) -> bool:
        """True if a trace row is due by time, or at most once a second by the distance driven or a changed status."""
        most_rows = DAY_NS / (self._settings.trace_every_s * 1e9)
        quiet_ns = now_ns - stream.trace_ns
        if quiet_ns < 0:  # the clock was set back
            quiet_ns = DAY_NS
        rows_left = min(most_rows, stream.rows_left + quiet_ns * most_rows / DAY_NS)
        here, before = None if place is None else place[:2], stream.trace_map_m
        has_moved = here is not None and (
            before is None or math.dist(here, before) * max(0.0, rows_left - 1) >= _TRACE_STEP_M * most_rows
        )
        is_changed = health.status != stream.status or has_moved
        due = quiet_ns >= self._settings.trace_every_s * 1e9 or (is_changed and quiet_ns >= _LEAST_BETWEEN_TRACES_NS)
        if due:
            stream.trace_ns, stream.status = now_ns, health.status
            stream.trace_map_m, stream.rows_left = here, rows_left - 1
        return due

    def _grid(self, site: str, version: int | None) -> _Grid | None:
        """Return the tiles of a version; None if it is not in the store."""
        if version is None:
            return None
        if (site, version) not in self._grids:
            try:
                manifest = self._store.manifest(site, version)
            except FleetmapError:
                return None  # not cached: it may be imported later
            cells = frozenset((tile.x, tile.y) for tile in manifest.tiles)
            self._grids[site, version] = _Grid(manifest.tile_size_m, cells)
        return self._grids[site, version]

    def _canary(self, site: str, now_ns: int) -> CanaryRow | None:
        if not 0 <= now_ns - self._canaries_ns < _CANARIES_KEPT_NS:
            self._canaries = {row.site: row for row in self._store.canaries(running=True)}
            self._canaries_ns = now_ns
        return self._canaries.get(site)

    def _areas_of(self, site: str, now_ns: int) -> Areas:
        """Return the areas of a site; none if unreadable, so that reports are still counted."""
        known = self._areas.get(site)
        if known is None or not 0 <= now_ns - known[0] < _AREAS_KEPT_NS:
            try:
                found = self._store.areas(site)
            except FleetmapError:
                found = Areas()
            known = self._areas[site] = (now_ns, found)
        return known[1]

    def _cause(self, site: str, cause: str) -> str:
        with self._lock:
            known = self._causes.setdefault(site, set())
            if cause not in known and len(known) >= _MAX_CAUSES:
                return "other"
            known.add(cause)
            return cause


def _keys(robot: str, version: int | None, grid: _Grid | None, arm: str | None) -> list[tuple[str, str]]:
    """Return axes and keys; numbers are those of versions in the store, with a grid: robots cannot invent keys."""
    known = "none" if version is None else str(version) if grid is not None else "unknown"
    keys = [("site", ""), ("robot", robot), ("version", known)]
    return keys if arm is None else [*keys, ("arm", arm)]


def _arm(canary: CanaryRow | None, version: int | None) -> str | None:
    """Return the arm of a canary's comparison for a robot; None for one that runs a third version."""
    if canary is None or version not in {canary.version, canary.base_version}:
        return None
    return arm_key(canary.id, is_canary=version == canary.version)


def arm_key(canary: int, *, is_canary: bool) -> str:
    """Return the key of one arm of a canary's comparison."""
    return f"{canary}:{'canary' if is_canary else 'others'}"


def _trace(health: RobotHealth, place: tuple[float, float, float] | None, now_ns: int) -> TraceRow:
    row: dict[str, Any] = {name: getattr(health, name) for name in ("site", "robot", "stamp_ns", "status", "version")}
    row |= {name: number_of(health.metrics.get(metric)) for name, metric in _TRACED.items()}
    x_m, y_m = (None, None) if place is None else place[:2]
    row |= {"hour": hour_of(now_ns), "heard_ns": now_ns, "flags": ",".join(health.flags) or None}
    return TraceRow(**row, x_map_m=x_m, y_map_m=y_m)
