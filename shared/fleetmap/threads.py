"""Threads of programs that run for weeks."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fleetmap.errors import FleetmapError

_WAIT_S, _LONGEST_WAIT_S = 1.0, 30.0
Job = Callable[[], None]
Clock = Callable[[], float]
_log = logging.getLogger(__name__)


class Jobs:
    """Jobs that a thread does in turn. One that fails is logged and waits, twice as long each time; the others go on."""

    def __init__(self, *jobs: Job, passed: type[Exception] | tuple[()] = (), clock_s: Clock = time.monotonic) -> None:
        """passed: errors that `work` raises, without the jobs after that one."""
        self._due_s = dict.fromkeys(jobs, (0.0, _WAIT_S))
        self._passed, self._clock_s = passed, clock_s

    def work(self) -> None:
        """Do every job that does not wait."""
        for job, (due_s, wait_s) in self._due_s.items():
            if self._clock_s() < due_s:
                continue
            try:
                job()
                self._due_s[job] = 0.0, _WAIT_S
            except self._passed:
                raise
            except Exception as error:
                self._due_s[job] = self._clock_s() + wait_s, min(2 * wait_s, _LONGEST_WAIT_S)
                is_known = isinstance(error, FleetmapError)
                _log.warning("%s; next attempt in %.0f s", error, wait_s, exc_info=not is_known)


@contextmanager
def ended_by_threads(stop: Callable[[], None]) -> Iterator[None]:
    """End a program if one of its threads dies: its error is logged, `stop` is called, and the block's end raises the reason.

    The reason is a FleetmapError: the thread's own, or one that names the thread and its error. An error of the block takes precedence.
    """
    errors: list[FleetmapError] = []

    def died(fault: threading.ExceptHookArgs) -> None:
        name = "unknown" if fault.thread is None else fault.thread.name
        error = fault.exc_value
        if isinstance(error, FleetmapError):
            _log.error("the thread %s ended: %s", name, error)
            errors.append(error)
        else:
            _log.error("the thread %s died", name, exc_info=error)
            words = f"{fault.exc_type.__name__}: {error}"
            errors.append(FleetmapError(f"the thread {name} died ({words}); the log above says where: report it"))
        stop()

    before, threading.excepthook = threading.excepthook, died
    try:
        yield
    finally:
        threading.excepthook = before
    if errors:
        raise errors[0]
