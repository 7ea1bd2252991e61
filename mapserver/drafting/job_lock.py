"""Running jobs and nights: their locks, which end with the process that holds them, and their records in the store."""

import io
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from fleetmap.errors import BusyError, FleetmapError, disk_errors
from fleetmap.files import OWN_FILE
from mapserver.store import MapStore

INTERRUPTED = "interrupted"
"""Key in the report of a job that was ended as interrupted."""

_TOLD_EVERY_S = 2.0
_LOGS_KEPT, _LOG_BYTES = 200, 4 << 20
_YOUNG_S = 60.0  # a job is recorded before it holds its lock


@contextmanager
def held(maps: MapStore, job: int) -> Iterator[None]:
    """Mark a job as running, for the block. Raises StoreError if the lock cannot be written."""
    with _locked(maps, _lock_name(job), waits=True):
        try:
            yield
        finally:
            with suppress(OSError):
                (maps.folder / _lock_name(job)).unlink()


@contextmanager
def only_one(maps: MapStore, site: str) -> Iterator[None]:
    """Hold the site's nightly lock for the block; raises BusyError if another process holds it, StoreError on a disk error."""
    name = f"nightly-{site}.lock"
    with ExitStack() as stack:
        try:
            stack.enter_context(_locked(maps, name, waits=False))
        except BusyError as error:
            raise BusyError(f"another nightly run of site {site} holds {name}; it ends by itself; try later") from error
        yield


def end_interrupted(maps: MapStore, now_ns: int) -> list[int]:
    """Mark jobs as failed that are recorded as running without a process; return their numbers."""
    ended = []
    for job in maps.running_jobs():
        begun_s = datetime.fromisoformat(job.started).astimezone(UTC).timestamp()
        if 0 <= now_ns / 1e9 - begun_s < _YOUNG_S:
            continue
        try:
            with _locked(maps, _lock_name(job.id), waits=False):
                pass
        except FleetmapError:  # a living process holds the lock, or that is unknown
            continue
        message = "was interrupted: its process has ended; run it again, a nightly run resumes at the next start"
        maps.update_job(job.id, "failed", message, job.report | {INTERRUPTED: True})
        with suppress(OSError):
            (maps.folder / _lock_name(job.id)).unlink()
        ended.append(job.id)
    return ended


def _lock_name(job: int) -> str:
    return f"job-{job}.lock"


@contextmanager
def logged(store: Path, job: int) -> Iterator[None]:
    """Copy the block's output on stderr, and the traceback of an error, into the job's log; not from a terminal, whose user reads it.

    The logs of the last 200 jobs are kept. A full disk ends the log, not the job.
    """
    if sys.stderr.isatty():
        yield
        return
    with suppress(OSError):
        for old in store.glob("job-*.log"):
            if old.stem[4:].isdecimal() and int(old.stem[4:]) <= job - _LOGS_KEPT:
                old.unlink()
    path = log_path(store, job)
    try:
        path.touch(OWN_FILE)
        file = path.open("wb", 0)
    except OSError:
        yield
        return
    copied = _LogCopy(sys.stderr, file)
    with file, redirect_stderr(copied):
        try:
            yield
        except FleetmapError as error:
            copied.log(f"{error}\n")
            raise
        except BaseException:
            copied.log(traceback.format_exc())
            raise


def log_path(store: Path, job: int) -> Path:
    """Return the path of a job's log; a job that ran in a terminal has none."""
    return store / f"job-{job}.log"


class _LogCopy(io.TextIOBase):
    """A stream whose text is copied into a log, up to `_LOG_BYTES`. A full disk under either ends neither the other nor the job."""

    def __init__(self, stream: TextIO, file: io.RawIOBase) -> None:
        self._stream, self._file, self._left = stream, file, _LOG_BYTES

    def write(self, text: str) -> int:
        self.log(text)
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def log(self, text: str) -> None:
        data = text.encode("utf-8", "backslashreplace")[: self._left]
        self._left -= len(data)
        with suppress(OSError):
            self._file.write(data)

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()

    def fileno(self) -> int:
        return self._stream.fileno()


@contextmanager
def _locked(maps: MapStore, name: str, *, waits: bool) -> Iterator[None]:
    with ExitStack() as stack:
        with disk_errors(f"{maps.folder / name} cannot be made", "check the store's rights and space"):
            stack.enter_context(maps.locked(name, waits=waits))
        yield


@dataclass(slots=True)
class Job:
    """Result of a job. number: None if the store has no row for it."""

    message: str = ""
    report: dict[str, Any] = field(default_factory=dict)
    number: int | None = None


class JobProgress:
    """Stores the progress of a job, from calls (stage, done, total), at most every two seconds."""

    def __init__(self, maps: MapStore, job: int | None, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._maps, self._job, self._clock_s = maps, job, clock_s
        self._stage, self._begun_s, self._told_s = "", 0.0, -_TOLD_EVERY_S

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Store it. With a busy store this update is skipped; the build continues."""
        now_s = self._clock_s()
        if stage != self._stage:
            self._stage, self._begun_s = stage, now_s
        elif now_s - self._told_s < _TOLD_EVERY_S:
            return
        self._told_s = now_s
        if self._job is not None:
            stage_s = round(now_s - self._begun_s, 1)
            with suppress(FleetmapError):
                self._maps.tell_progress(self._job, {"stage": stage, "done": done, "total": total, "stage_s": stage_s})


@contextmanager
def recorded_job(maps: MapStore, site: str, kind: str) -> Iterator[Job]:
    """Record a job as running, then as done, or as failed with the error that ended it.

    A killed job stays recorded as running until the server, or the next job, finds its lock released.
    """
    end_interrupted(maps, time.time_ns())
    number = maps.begin_job(site, kind)
    job = Job(number=number)
    try:
        with held(maps, number), logged(maps.folder, number):
            yield job
    except BaseException as error:
        maps.update_job(number, "failed", str(error) or type(error).__name__, job.report)
        raise
    maps.update_job(number, "done", job.message, job.report)
