"""Patience of tests with what other threads and processes do."""

import os
import signal
import threading
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
def repeated(act: Callable[[], object], every_s: float) -> Iterator[None]:
    """A thread acts again and again until the block ends."""
    over = threading.Event()

    def go_on() -> None:
        while not over.wait(every_s):
            act()

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


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
