"""Use of the disk by the store. Counting every file takes minutes in a large store, so a thread measures and the last result is kept."""

import logging
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from fleetmap.errors import FleetmapError, disk_errors
from mapserver.store.blobs import Blobs
from mapserver.store.database import Database

_EVERY_S, _DAY_S = 600.0, 86_400.0
_WAIT_S = 0.5  # for a measurement under way: that of a small store is done by then
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StoreUsage:
    """Bytes by purpose. measured_ns: when; maps: files of all versions; pictures and recordings: of failures; database: the rest of it."""

    measured_ns: int
    maps_bytes: int
    pictures_bytes: int
    recordings_bytes: int
    database_bytes: int


class UsageMeter:
    """Measures a store when asked, at most every ten minutes. Thread-safe."""

    def __init__(self, root: Path, database: Database, blobs: Blobs) -> None:
        self._root, self._database, self._blobs = root, database, blobs
        self._lock, self._due_s, self._thread = threading.Lock(), 0.0, threading.Thread()
        self._last: StoreUsage | None = None

    def look(self) -> StoreUsage | None:
        """Return the last measurement; None while the first is under way, or if the disk refuses it."""
        with self._lock:
            if not self._thread.is_alive() and time.monotonic() >= self._due_s:
                self._due_s = time.monotonic() + _EVERY_S
                self._thread = threading.Thread(target=self._measure, name="store usage", daemon=True)
                self._thread.start()
        self._thread.join(_WAIT_S)
        return self._last

    def _measure(self) -> None:
        try:
            with disk_errors(f"{self._root} cannot be measured", "check the disk"):
                pictures, recordings = (
                    self._database.value(f"SELECT coalesce(sum(length({column})), 0) FROM {table}")
                    for table, column in (("failure_pictures", "jpeg"), ("failure_replays", "mcap"))
                )
                database_bytes = max(0, self._database.total_bytes() - pictures - recordings)
                sizes = (self._blobs.total_bytes(), pictures, recordings, database_bytes)
                self._last = StoreUsage(self._database.now_ns(), *sizes)
        except FleetmapError as error:
            _log.warning("%s", error)


@dataclass(frozen=True, slots=True)
class DiskSpace:
    """Space of the disk that holds the store; free: for this account.

    grows_bytes_per_day: of what is used, None until it was measured for a day. days_left: until it is full at that,
    None if it does not fill.
    """

    total_bytes: int
    free_bytes: int
    grows_bytes_per_day: float | None = None
    days_left: float | None = None


class DiskMeter:
    """Measures the disk of a folder, and its growth since the process began, over a week at most. Thread-safe."""

    def __init__(self, root: Path, now_ns: Callable[[], int]) -> None:
        self._root, self._now_ns, self._lock = root, now_ns, threading.Lock()
        self._samples = deque[tuple[int, int]](maxlen=round(7 * _DAY_S / _EVERY_S))  # stamps and free bytes

    def look(self) -> DiskSpace:
        """Return the space; StoreError if the disk does not answer."""
        with disk_errors(f"{self._root} cannot be looked at", "check the disk"):
            found = shutil.disk_usage(self._root)
        with self._lock:
            now_ns = self._now_ns()
            if self._samples and now_ns < self._samples[-1][0]:
                self._samples.clear()  # the clock was set back
            if not self._samples or now_ns - self._samples[-1][0] >= _EVERY_S * 1e9:
                self._samples.append((now_ns, found.free))
            samples = list(self._samples)
        if not samples or samples[-1][0] - samples[0][0] < _DAY_S * 1e9:
            return DiskSpace(found.total, found.free)
        # Medians of the first and the last quarter, as a build's temporary files come and go
        quarter = max(1, len(samples) // 4)
        ends = [
            [median(column) for column in zip(*part, strict=True)] for part in (samples[:quarter], samples[-quarter:])
        ]
        grows = float((ends[0][1] - ends[1][1]) / (ends[1][0] - ends[0][0]) * _DAY_S * 1e9)
        return DiskSpace(found.total, found.free, grows, found.free / grows if grows > 0 else None)
