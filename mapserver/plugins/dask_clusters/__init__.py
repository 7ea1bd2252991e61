"""An executor for surveys: the processes of a dask cluster.

Data travel as pickles, which run code when they are loaded: the cluster is reached by TLS with certificates on both sides.
"""

import pickle
import secrets
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import Any

import cv2
from threadpoolctl import threadpool_limits

from fleetmap.errors import LinkError, UsageError
from mapserver.drafting.worker import AHEAD, in_order
from mapserver.survey.executor import Batch, Result, Shared

_CONNECT_WITHIN_S = 20.0


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
            ahead = AHEAD * max(1, sum(self._client.nthreads().values()))

        def submit(batch: Batch) -> Any:
            with _cluster_errors():
                return self._client.submit(_do, function, there, pickle.dumps(batch, protocol=5), pure=False)

        def result(future: Any) -> Result:
            with _cluster_errors():
                return pickle.loads(future.result())  # type: ignore[no-any-return]

        return in_order(submit, result, batches, ahead)


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


@contextmanager
def open_cluster(scheduler: str) -> Iterator[Cluster]:
    """Open the executor of a scheduler's address. UsageError for one without TLS or workers, or one that does not answer."""
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
        yield Cluster(client)
