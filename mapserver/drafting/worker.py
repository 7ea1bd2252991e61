"""Executors for surveys: threads of this process, or the processes of a dask cluster.

Threads copy nothing, and the core releases the interpreter's lock. Data for a cluster travel as pickles, which run code when they are
loaded: the cluster is reached by TLS with certificates on both sides.
"""

import os
import pickle
import secrets
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import cv2
from threadpoolctl import threadpool_limits

from fleetmap.errors import LinkError, UsageError
from mapserver.survey.executor import SERIAL, Batch, Executor, Result, Shared

Item = TypeVar("Item")
_AHEAD = 2  # waiting batches per thread or process; a limit, so that long surveys are not in memory twice
_CONNECT_WITHIN_S = 20.0


class Threads:
    """An executor of threads; results are computed ahead of their use."""

    def __init__(self, pool: ThreadPoolExecutor, count: int) -> None:
        self._pool, self._ahead = pool, _AHEAD * count

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        return _in_order(lambda batch: self._pool.submit(function, shared, batch), Future.result, batches, self._ahead)


class Cluster:
    """An executor of the processes behind a dask client.

    Everything travels as fleetmap's pickles: arrays unpacked by dask itself are read-only.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._shared: tuple[Any, Any] = (None, None)  # the last shared value, and its location

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        with _cluster_errors():
            if self._shared[0] is not shared:
                packed = (secrets.token_hex(8), pickle.dumps(shared, protocol=5))
                self._shared = (shared, self._client.scatter([packed], broadcast=True, hash=False)[0])
            there = self._shared[1]
            ahead = _AHEAD * max(1, sum(self._client.nthreads().values()))

        def submit(batch: Batch) -> Any:
            with _cluster_errors():
                return self._client.submit(_do, function, there, pickle.dumps(batch, protocol=5), pure=False)

        def result(future: Any) -> Result:
            with _cluster_errors():
                return pickle.loads(future.result())  # type: ignore[no-any-return]

        return _in_order(submit, result, batches, ahead)


@contextmanager
def _cluster_errors() -> Iterator[None]:
    """Raise LinkError for a cluster that is lost: a night ends, and blames no recording. dask itself replaces single workers."""
    from distributed import KilledWorker

    try:
        yield
    except (CancelledError, OSError, ImportError, KilledWorker) as error:
        raise LinkError(
            f"the dask cluster has lost the build ({error}); see the logs of its scheduler and workers, then run it again"
        ) from error


_unpacked: dict[str, Any] = {}  # in a process of the cluster: the shared value, by its name


def _do(function: Callable[[Any, Any], Any], packed: tuple[str, bytes], batch: bytes) -> bytes:
    """Run one batch in a process of the cluster."""
    name, data = packed
    if name not in _unpacked:
        cv2.setNumThreads(1)  # as `single_threaded_libraries`, permanently: this process has no other task
        threadpool_limits(1, user_api="blas")
        _unpacked.clear()
        _unpacked[name] = pickle.loads(data)
    return pickle.dumps(function(_unpacked[name], pickle.loads(batch)), protocol=5)


def _in_order(
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
    """Open threads (one per core by default), or the cluster of a scheduler.

    Raises UsageError for a scheduler without TLS or workers, or one that does not answer; the executor LinkError for a lost cluster.
    """
    count = threads or len(os.sched_getaffinity(0))
    if scheduler is not None:
        with _client(scheduler) as client:
            yield Cluster(client)
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


@contextmanager
def _client(scheduler: str) -> Iterator[Any]:
    if not scheduler.startswith("tls://"):
        raise UsageError(
            f"--scheduler {scheduler}: anyone who can connect to a scheduler without TLS can run code in it; name one by "
            "tls://HOST:PORT, with its certificates in dask's configuration, or leave it out: threads use all cores here"
        )
    from distributed import Client

    try:
        client = Client(scheduler, timeout=_CONNECT_WITHIN_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(
            f"--scheduler {scheduler} does not answer ({error}); start it with `dask scheduler --tls-...`, or leave it out"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_WITHIN_S)
        except TimeoutError as error:
            raise UsageError(f"--scheduler {scheduler} has no workers; start `dask worker {scheduler}`") from error
        yield client


def read_ahead(items: Iterable[Item], ahead: int = 4) -> Iterator[Item]:
    """Yield the items of a generator, fetched ahead by a thread. Errors are raised at the position of their item."""
    source = iter(items)
    end = object()
    with ThreadPoolExecutor(1, thread_name_prefix="reader") as pool:
        waiting = deque(pool.submit(next, source, end) for _ in range(ahead))
        while True:
            item = waiting.popleft().result()
            if item is end:
                return
            waiting.append(pool.submit(next, source, end))
            yield item  # type: ignore[misc]
