"""Executors for surveys: threads of this process, which copy nothing while the core releases the interpreter's lock; or a plug-in's."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import repeat, takewhile
from typing import Any, TypeVar

import cv2
from threadpoolctl import threadpool_limits

from mapserver.hooks import open_url
from mapserver.survey.executor import SERIAL, Batch, Executor, Result, Shared

Item = TypeVar("Item")
AHEAD = 2  # waiting batches per thread or process; a limit, so that long surveys are not in memory twice


class Threads:
    """An executor of threads; results are computed ahead of their use."""

    def __init__(self, pool: ThreadPoolExecutor, count: int) -> None:
        self._pool, self._ahead = pool, AHEAD * count

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        return in_order(lambda batch: self._pool.submit(function, shared, batch), Future.result, batches, self._ahead)


def in_order(
    submit: Callable[[Any], Any], result: Callable[[Any], Any], batches: Iterable[Any], ahead: int
) -> Iterator[Any]:
    """Yield results in the batches' order, with at most `ahead` of them in progress."""
    waiting: deque[Any] = deque()
    for batch in batches:
        waiting.append(submit(batch))
        if len(waiting) > ahead:
            yield result(waiting.popleft())
    while waiting:
        yield result(waiting.popleft())


@contextmanager
def open_executor(threads: int | None, scheduler: str | None) -> Iterator[Executor]:
    """Open threads (one per core by default), or what a plug-in opens at the address of a scheduler (`mapserver.executors`)."""
    count = threads or len(os.sched_getaffinity(0))
    if scheduler is not None:
        with open_url("mapserver.executors", scheduler, "--scheduler")(scheduler) as executor:
            yield executor
    elif count == 1:
        yield SERIAL
    else:
        with ThreadPoolExecutor(count, thread_name_prefix="survey") as pool, single_threaded_libraries():
            yield Threads(pool, count)


@contextmanager
def single_threaded_libraries() -> Iterator[None]:
    """Run OpenCV and linear algebra with one thread each for the block.

    With a thread on every core, further threads of these libraries only wait for each other, OpenBLAS's at full load: on two busy
    cores a survey took four times the CPU seconds.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)


def read_ahead(items: Iterable[Item], ahead: int = 4) -> Iterator[Item]:
    """Yield the items of a generator, fetched ahead by a thread. Errors are raised at the position of their item."""
    source, end = iter(items), object()
    with ThreadPoolExecutor(1, thread_name_prefix="reader") as pool:
        fetched = in_order(lambda _: pool.submit(next, source, end), Future.result, repeat(None), ahead)
        yield from takewhile(lambda item: item is not end, fetched)
