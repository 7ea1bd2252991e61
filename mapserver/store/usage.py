"""Use of the disk by the store. Counting every file takes minutes in a large store, so a thread measures and the last result is kept."""

import logging
import shutil
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from fleetmap.errors import FleetmapError, disk_errors
from mapserver.store.blobs import BlobFolder
from mapserver.store.database import Transactions

_EVERY_S = 600.0
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

    def __init__(self, root: Path, transactions: Transactions, blobs: BlobFolder) -> None:
        self._root, self._transactions, self._blobs = root, transactions, blobs
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._due_s = 0.0
        self._last: StoreUsage | None = None

    def look(self) -> StoreUsage | None:
        """Return the last measurement; None while the first is under way, or if the disk refuses it."""
        with self._lock:
            if self._thread is None and time.monotonic() >= self._due_s:
                self._thread = threading.Thread(target=self._measure, name="store usage", daemon=True)
                self._thread.start()
            thread = self._thread
        if thread is not None:
            thread.join(_WAIT_S)
        return self._last

    def _measure(self) -> None:
        try:
            with disk_errors(f"{self._root} cannot be measured", "check the disk"):
                self._last = self._measured()
        except FleetmapError as error:
            _log.warning("%s", error)
        finally:
            with self._lock:
                self._thread, self._due_s = None, time.monotonic() + _EVERY_S

    def _measured(self) -> StoreUsage:
        (kept,) = self._transactions.query(
            """SELECT (SELECT coalesce(sum(length(jpeg)), 0) FROM failure_pictures) pictures,
                      (SELECT coalesce(sum(length(mcap)), 0) FROM failure_replays) recordings"""
        )
        files_bytes = sum(path.stat().st_size for path in self._root.glob("store*.sqlite3*"))
        database_bytes = max(0, files_bytes - kept["pictures"] - kept["recordings"])
        now_ns, maps_bytes = self._transactions.now_ns(), self._blobs.total_bytes()
        return StoreUsage(now_ns, maps_bytes, kept["pictures"], kept["recordings"], database_bytes)


@dataclass(frozen=True, slots=True)
class DiskSpace:
    """Space of the disk that holds the store; free: for this account."""

    total_bytes: int
    free_bytes: int


def disk_space(root: Path) -> DiskSpace:
    """Return the space of a folder's disk; StoreError if the disk does not answer."""
    with disk_errors(f"{root} cannot be looked at", "check the disk"):
        found = shutil.disk_usage(root)
    return DiskSpace(found.total, found.free)
