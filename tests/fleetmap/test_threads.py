"""A thread that dies ends its program, with its reason."""

import logging
import threading

import pytest

from fleetmap.errors import FleetmapError, StoreError
from fleetmap.threads import ended_by_threads


def run(error: BaseException | None) -> threading.Event:
    """A program that works until it is stopped, with a thread that ends with this error."""

    def work() -> None:
        if error is not None:
            raise error
        stopped.set()

    stopped = threading.Event()
    with ended_by_threads(stopped.set):
        threading.Thread(target=work, name="network").start()
        assert stopped.wait(10)
    return stopped


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (TypeError("numpy.float64"), FleetmapError, r"the thread network died \(TypeError: numpy.float64\)"),
        (MemoryError(), FleetmapError, r"the thread network died \(MemoryError: \)"),
        (StoreError("the disk is full; make room"), StoreError, "^the disk is full; make room$"),
    ],
)
def test_what_ends_a_thread_ends_the_program(
    error: BaseException, kind: type[FleetmapError], words: str, caplog: pytest.LogCaptureFixture
) -> None:
    hook = threading.excepthook
    with caplog.at_level(logging.ERROR), pytest.raises(kind, match=words):
        run(error)
    assert "the thread network" in caplog.text
    assert threading.excepthook is hook


def test_a_thread_that_ends_well_and_an_error_of_the_block() -> None:
    assert run(None).is_set()
    with pytest.raises(ZeroDivisionError), ended_by_threads(lambda: None):
        raise ZeroDivisionError
