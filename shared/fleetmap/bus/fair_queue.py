"""A bounded queue that serves its senders in turn, so that one who floods is dropped and the others are not late."""

import logging
import threading
from collections import deque
from collections.abc import Callable

_MAX_SENDERS = 20_000
_MAX_BYTES = 32 << 20  # of all senders together
_JOB_BYTES = 1000  # what a job takes beside its bytes, so that empty ones are bounded too
SHARED = ""
"""The sender of what names no robot, such as a survey under way."""

_LIMITS = {False: (64, 2 << 20), True: (4096, 8 << 20)}  # messages and bytes that wait, of a robot and of SHARED
_log = logging.getLogger(__name__)


def sender_of(key: str) -> str:
    """Who asks or tells under a key of the bus: fleetmap/SITE/robots/ROBOT/..., else SHARED."""
    chunks = key.split("/", 4)
    return f"{chunks[1]}/{chunks[3]}" if len(chunks) == 5 and chunks[2] == "robots" else SHARED


class FairQueue:
    """Jobs of senders, done by one thread: each sender's in their order, the senders in turn."""

    def __init__(self, name: str) -> None:
        self._ready = threading.Condition()
        self._jobs: dict[str, deque[tuple[int, Callable[[], None]]]] = {}  # in the order of their turns
        self._bytes: dict[str, int] = {}
        self._all_bytes = 0
        self._is_closed = False
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def put(self, sender: str, size: int, job: Callable[[], None]) -> bool:
        """Queues a job of `size` bytes; False where it is dropped, because the sender has too much waiting or all have."""
        with self._ready:
            waiting = self._jobs.get(sender)
            if waiting is None:
                if len(self._jobs) >= _MAX_SENDERS:
                    return False
                waiting = self._jobs[sender] = deque()
            own = self._bytes.get(sender, 0) + size
            most, most_bytes = _LIMITS[sender == SHARED]
            is_full = len(waiting) >= most or own > most_bytes or self._all_bytes + size + _JOB_BYTES > _MAX_BYTES
            if is_full or self._is_closed:
                if not waiting:
                    del self._jobs[sender]
                return False
            waiting.append((size, job))
            self._bytes[sender], self._all_bytes = own, self._all_bytes + size + _JOB_BYTES
            self._ready.notify()
            return True

    def close(self) -> None:
        """Drops what waits and ends the thread after its present job."""
        with self._ready:
            self._is_closed = True
            self._jobs.clear()
            self._ready.notify()

    def _run(self) -> None:
        while True:
            with self._ready:
                while not self._jobs and not self._is_closed:
                    self._ready.wait()
                if self._is_closed:
                    return
                sender = next(iter(self._jobs))
                waiting = self._jobs.pop(sender)
                size, job = waiting.popleft()
                self._all_bytes -= size + _JOB_BYTES
                if waiting:
                    self._jobs[sender] = waiting  # behind the others
                    self._bytes[sender] -= size
                else:
                    del self._bytes[sender]
            try:
                job()
            except Exception:
                # A fault in one job must not end the others.
                _log.exception("a job of %r failed", sender)
