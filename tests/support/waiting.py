"""Patience of tests with what other threads and processes do."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any


def eventually(condition: Callable[[], bool], within_s: float = 10.0) -> bool:
    deadline = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


@contextmanager
def within_another_process(
    context: Callable[..., AbstractContextManager[Any]], *given: Any, **how: Any
) -> Iterator[None]:
    """Another process is within a context, and killed there in the end."""
    told, tell = os.pipe()
    child = os.fork()
    if child == 0:
        with context(*given, **how):
            os.write(tell, b"x")
            signal.pause()
        os._exit(0)
    os.read(told, 1)
    try:
        yield
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
