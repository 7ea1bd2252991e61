"""Executors for surveys: threads of this process, processes of this machine, or those of a dask cluster elsewhere.

Two cores are served best by threads: the kernels run without the interpreter's lock, and nothing is copied. Long work that needs the
interpreter goes on in a process beside them. Processes take over where there are many cores, or several machines. What travels between
them are pickles, which run code where they are opened: processes of this machine are reached by pipes that only their parent holds, a
cluster by TLS with certificates on both sides.
"""

import gc
import os
import pickle
import resource
import secrets
import select
import signal
import socket
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread
from typing import Any, Self, TypeVar

import cv2
from threadpoolctl import threadpool_limits

from fleetmap.errors import FleetmapError, UsageError
from mapserver.survey.executor import SERIAL, Batch, Executor, Result, Shared, Work

Item = TypeVar("Item")
EMBEDDED = "local"
_AHEAD = 2  # batches for each thread or process that wait, so that long surveys are not in memory twice
_CONNECT_WITHIN_S = "20s"


class Threads:
    """An executor of threads; results are computed ahead of who asks for them."""

    def __init__(self, pool: ThreadPoolExecutor, count: int, side: "SideProcess | None" = None) -> None:
        self._pool, self._ahead, self._side = pool, _AHEAD * count, side

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        return _in_order(lambda batch: self._pool.submit(function, shared, batch), Future.result, batches, self._ahead)

    @property
    def nearby(self) -> Executor:
        return self

    def beside(self, function: Callable[..., Result], *arguments: Any) -> Work[Result] | None:
        return None if self._side is None else self._side.submit(function, *arguments)


class SideProcess:
    """A process beside this one for long work, one piece after the other, whose interpreter waits for nobody's lock.

    What it cannot do, or died of, is done here: the answer is the same. It ends when this process does, however that ends. All that
    travels goes through a pair of sockets, so that nothing is left behind.
    """

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                self._process = _forked(ours, theirs) if _is_one_thread() else _started(theirs)
            except OSError:
                ours.close()
                raise
        self._socket, self._pipe, self._is_closed = ours, Connection(os.dup(ours.fileno())), False
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="beside")
        self.peak_rss_bytes = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Ends the process, whatever it is at."""
        self._is_closed = True
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes who waits for an answer
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(self._process, signal.SIGKILL)
            os.waitpid(self._process, 0)
        self._pool.shutdown(cancel_futures=True)
        self._pipe.close()
        self._socket.close()

    def submit(self, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """function(*arguments) there, after what was submitted before."""
        return self._pool.submit(self._ask, function, arguments)

    def _ask(self, function: Callable[..., Result], arguments: tuple[Any, ...]) -> Result:
        task = pickle.dumps((function, arguments), protocol=5)
        try:
            self._pipe.send_bytes(task)
            is_result, value, self.peak_rss_bytes = pickle.loads(self._pipe.recv_bytes())
        except (EOFError, OSError):  # it has died
            is_result, value = False, None
        if self._is_closed:
            raise CancelledError
        if isinstance(value, FleetmapError) and not is_result:
            raise value
        return value if is_result else function(*arguments)


def _is_one_thread() -> bool:
    """Whether no other thread can hold a lock that a copy of this process would wait for in vain."""
    tasks = Path("/proc/self/task")
    return tasks.is_dir() and len(list(tasks.iterdir())) == 1


def _forked(ours: socket.socket, theirs: socket.socket) -> int:
    """A copy of this process, which has loaded all that it needs."""
    process = os.fork()
    if process == 0:
        try:
            ours.close()
            os.setpgid(0, 0)  # Ctrl-C is for this process's own group, which ends the other
            serve_beside(theirs.detach())
        finally:
            os._exit(0)
    return process


def _started(theirs: socket.socket) -> int:
    """A new process, which finds its socket where input would come from, and loads what it needs while it has nothing to do."""
    program = f"import mapserver.build.survey_beginnings; from {__name__} import serve_beside; serve_beside(0)"
    command = [sys.executable, "-c", program]
    paths = {"PYTHONPATH": os.pathsep.join(path or str(Path.cwd()) for path in sys.path)}
    into = [(os.POSIX_SPAWN_DUP2, theirs.fileno(), 0)]
    return os.posix_spawn(sys.executable, command, os.environ | paths, file_actions=into, setpgroup=0)


def serve_beside(socket_number: int) -> None:
    """The process: answers (function, arguments) with (whether this is the result, the result or a FleetmapError, most memory it held)."""
    Thread(target=_end_with_parent, args=(socket_number,), daemon=True).start()
    _limit_libraries()
    gc.freeze()
    pipe = Connection(socket_number)
    with suppress(EOFError, OSError):
        while True:
            function, arguments = pickle.loads(pipe.recv_bytes())
            try:
                answer: tuple[bool, Any] = True, function(*arguments)
            except FleetmapError as error:
                answer = False, error
            except Exception:  # raised where it can be seen, when the other process tries the same
                answer = False, None
            most_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            pipe.send_bytes(pickle.dumps((*answer, most_bytes), protocol=5))


def _end_with_parent(socket_number: int) -> None:
    """Ends this process as soon as the other end of its socket is closed, also in the middle of work."""
    poll = select.poll()
    poll.register(socket_number, 0)  # hanging up is always reported
    poll.poll()
    os._exit(0)


class Processes:
    """An executor of processes of this machine; `folder` holds what they share."""

    def __init__(self, pool: ProcessPoolExecutor, count: int, folder: Path) -> None:
        self._pool, self._ahead, self._folder = pool, _AHEAD * count, folder
        self._shared: Any = None
        self._files: list[
            Path
        ] = []  # of what is shared now, and of what was before: its results may still be on their way

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        if self._shared is not shared or not self._files:
            for old in self._files[:-1]:
                old.unlink()
            self._shared, self._files = shared, [*self._files[-1:], self._folder / secrets.token_hex(8)]
            self._files[-1].write_bytes(pickle.dumps(shared, protocol=5))
        there = self._files[-1]

        def submit(batch: Batch) -> Any:
            return self._pool.submit(_do_shared, function, there, pickle.dumps(batch, protocol=5))

        return _in_order(submit, lambda future: pickle.loads(future.result()), batches, self._ahead)

    @property
    def nearby(self) -> Executor:
        return SERIAL

    def beside(self, function: Callable[..., Result], *arguments: Any) -> Work[Result] | None:
        return None


class Cluster:
    """An executor of the processes behind a dask client.

    Everything travels as pickles of ours: arrays that dask unpacks itself cannot be written to, and numba would compile every
    kernel a second time for such.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._count = 0
        self._shared: tuple[Any, Any] = (None, None)  # the last value that was shared, and where it is

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        if self._shared[0] is not shared:
            packed = (secrets.token_hex(8), pickle.dumps(shared, protocol=5))
            self._shared = (shared, self._client.scatter([packed], broadcast=True, hash=False)[0])
        there = self._shared[1]
        ahead = _AHEAD * max(1, sum(self._client.nthreads().values()))

        def submit(batch: Batch) -> Any:
            return self._client.submit(_do, function, there, pickle.dumps(batch, protocol=5), pure=False)

        return _in_order(submit, lambda future: pickle.loads(future.result()), batches, ahead)

    @property
    def nearby(self) -> Executor:
        return SERIAL

    def beside(self, function: Callable[..., Result], *arguments: Any) -> Work[Result] | None:
        return None


_unpacked: dict[str, Any] = {}  # in a process of the cluster: what is shared now, by its name


def _do(function: Callable[[Any, Any], Any], packed: tuple[str, bytes], batch: bytes) -> bytes:
    """One batch in a process of the cluster."""
    name, data = packed
    if name not in _unpacked:
        _limit_libraries()
        _unpacked.clear()
        _unpacked[name] = pickle.loads(data)
    return pickle.dumps(function(_unpacked[name], pickle.loads(batch)), protocol=5)


def _do_shared(function: Callable[[Any, Any], Any], shared: Path, batch: bytes) -> bytes:
    """One batch in a process of this machine."""
    packed = (shared.name, b"" if shared.name in _unpacked else shared.read_bytes())
    return _do(function, packed, batch)


def _in_order(
    submit: Callable[[Any], Any], result: Callable[[Any], Any], batches: Iterable[Any], ahead: int
) -> Iterator[Any]:
    """Results in the batches' order, with at most `ahead` of them on their way."""
    waiting: deque[Any] = deque()
    for batch in batches:
        waiting.append(submit(batch))
        if len(waiting) > ahead:
            yield result(waiting.popleft())
    while waiting:
        yield result(waiting.popleft())


def open_side_process(threads: int | None) -> AbstractContextManager[SideProcess | None]:
    """A process beside this one; none where a survey has but one core, or where the machine has no room for a process."""
    if _cores(threads) > 1:
        with suppress(OSError):
            return SideProcess()
    return nullcontext()


@contextmanager
def open_side_thread(threads: int | None) -> Iterator[Callable[[Callable[[], None]], None]]:
    """Does what it is given, one piece after the other, beside the caller, who waits at the block's end and gets its first error there.

    Where a survey has but one core all is done at the block's end. An error of the block leaves out what has not begun.
    """
    if _cores(threads) == 1:
        later: list[Callable[[], None]] = []
        yield later.append
        for work in later:
            work()
        return
    with ThreadPoolExecutor(1, thread_name_prefix="joining") as pool:
        begun: list[Future[None]] = []
        try:
            yield lambda work: begun.append(pool.submit(work))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        for each in begun:
            each.result()


def _cores(threads: int | None) -> int:
    return threads or len(os.sched_getaffinity(0))


@contextmanager
def open_executor(threads: int | None, scheduler: str | None, side: SideProcess | None = None) -> Iterator[Executor]:
    """Threads (as many as there are cores, without a number), processes of this machine (`local`), or the cluster of a scheduler.

    side: goes on beside the threads. Raises UsageError for a scheduler that is not reached by TLS, or that does not answer.
    """
    count = _cores(threads)
    if scheduler == EMBEDDED:
        with (
            tempfile.TemporaryDirectory(prefix="fleetmap-") as folder,
            ProcessPoolExecutor(count, get_context("spawn"), _limit_libraries) as processes,
        ):
            yield Processes(processes, count, Path(folder))
    elif scheduler is not None:
        with _client(scheduler) as client:
            yield Cluster(client)
    elif count == 1:
        yield SERIAL
    else:
        with ThreadPoolExecutor(count, thread_name_prefix="survey") as pool, single_threaded_libraries():
            yield Threads(pool, count, side)


@contextmanager
def single_threaded_libraries() -> Iterator[None]:
    """OpenCV and linear algebra without threads of their own.

    Where ours have work for every core, theirs would only wait for each other, and OpenBLAS's do so at full load: on two busy cores a
    survey took four times the CPU seconds.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)


def _limit_libraries() -> None:
    """As `single_threaded_libraries`, for good: in a process that does nothing else."""
    cv2.setNumThreads(1)
    threadpool_limits(1, user_api="blas")


@contextmanager
def _client(scheduler: str) -> Iterator[Any]:
    if not scheduler.startswith("tls://"):
        raise UsageError(
            f"--scheduler {scheduler}: whoever reaches a scheduler without TLS runs code in it; name one by "
            f"tls://HOST:PORT, with its certificates in dask's configuration, or say `{EMBEDDED}`"
        )
    from distributed import Client

    try:
        client = Client(scheduler, timeout=_CONNECT_WITHIN_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(
            f"--scheduler {scheduler} does not answer ({error}); start it with `dask scheduler --tls-...`, or say `{EMBEDDED}`"
        ) from error
    with client:
        yield client


def read_ahead(items: Iterable[Item], ahead: int = 4) -> Iterator[Item]:
    """The items of a generator, fetched by a thread while the ones before are used. Errors come where their item would."""
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
