"""A bounded queue that serves senders round-robin, so that messages of a flooding sender are dropped and others are not delayed."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Hashable

_MAX_SENDERS = 20_000
_MAX_BYTES = 32 << 20  # of all senders together
_JOB_BYTES = 1000  # memory of a job besides its bytes, so that empty jobs are bounded too
SHARED = ""
"""Sender of messages that name no robot, such as those of a running survey."""

_LIMITS = {False: (64, 2 << 20), True: (4096, 8 << 20)}  # waiting messages and bytes, of a robot and of SHARED
_log = logging.getLogger(__name__)


def sender_of(key: str) -> str:
    """Sender of a message, from its key on the bus: fleetmap/SITE/robots/ROBOT/..., else SHARED."""
    chunks = key.split("/", 4)
    return f"{chunks[1]}/{chunks[3]}" if len(chunks) == 5 and chunks[2] == "robots" else SHARED


class FairQueue:
    """Jobs of several senders, run by one thread: round-robin over the senders, in order for each sender."""

    def __init__(self, name: str) -> None:
        self._ready = threading.Condition()
        self._jobs: dict[str, deque[tuple[int, Callable[[], None], Hashable]]] = {}  # in round-robin order
        self._bytes: dict[str, int] = {}
        self._all_bytes = 0
        self._is_closed = False
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def put(self, sender: str, size: int, job: Callable[[], None], question: Hashable = None) -> bool:
        """Queue a job of `size` bytes; return False if it is dropped because the sender's limit or the common limit is reached.

        question: that the job answers, None for none. It takes the place of one that waits for the same robot and question, whose answer
        nobody expects any more: a server that is behind does not work for those who have asked again.
        """
        with self._ready:
            waiting = self._jobs.get(sender)
            known = [] if question is None or sender == SHARED else [each[::2] for each in waiting or ()]
            if waiting and (size, question) in known:
                waiting[known.index((size, question))] = size, job, question
                return True
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
            waiting.append((size, job, question))
            self._bytes[sender], self._all_bytes = own, self._all_bytes + size + _JOB_BYTES
            self._ready.notify()
            return True

    def close(self) -> None:
        """Drop waiting jobs and end the thread after its current job."""
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
                size, job, _ = waiting.popleft()
                self._all_bytes -= size + _JOB_BYTES
                if waiting:
                    self._jobs[sender] = waiting  # behind the others
                    self._bytes[sender] -= size
                else:
                    del self._bytes[sender]
            try:
                job()
            except Exception:
                # An error in one job must not stop the others.
                _log.exception("a job of %r failed", sender)
