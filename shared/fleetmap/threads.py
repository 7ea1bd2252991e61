"""Threads of programs that run for weeks."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fleetmap.errors import FleetmapError

_log = logging.getLogger(__name__)


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
