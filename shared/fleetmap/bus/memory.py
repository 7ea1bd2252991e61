"""The bus inside one process, for tests and for replays without a server."""

import threading
from typing import Any

from fleetmap.bus.protocol import (
    Answer,
    Bus,
    Handle,
    Listen,
    answer_query,
    check_size,
    deliver,
    key_matches,
    no_answer,
    query_refused,
)
from fleetmap.errors import LinkError


class MemoryHub:
    """What MemoryBus participants share. `reachable` False plays a network that is away."""

    def __init__(self) -> None:
        self.reachable = True
        self.lock = threading.RLock()
        self.queryables: list[tuple[str, Answer]] = []
        self.subscribers: list[tuple[str, Listen]] = []
        self.tokens: list[str] = []
        self.members = 0


class MemoryBus(Bus):
    """A participant of a MemoryHub; callbacks run on the caller's thread."""

    def __init__(self, hub: MemoryHub) -> None:
        self._hub = hub
        self._handles: list[Handle] | None = []
        hub.members += 1

    def queryable(self, key_expr: str, answer: Answer) -> Handle:
        """See Bus."""
        return self._declare(self._hub.queryables, (key_expr, answer))

    def get(self, key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        """See Bus; never waits."""
        check_size(payload, key)
        with self._hub.lock:
            answers = [answer for key_expr, answer in self._hub.queryables if key_matches(key_expr, key)]
        if not self._hub.reachable or not answers:
            raise no_answer(key, timeout_s)
        data, reason = answer_query(answers[0], key, payload)
        if data is None:
            raise query_refused(key, reason)
        return data

    def publish(self, key: str, payload: bytes, *, may_drop: bool = False, attachment: bytes = b"") -> None:
        """See Bus."""
        check_size(payload, key)
        with self._hub.lock:
            listeners = [listen for key_expr, listen in self._hub.subscribers if key_matches(key_expr, key)]
        for listen in listeners if self._hub.reachable else []:
            deliver(listen, key, payload)

    def subscribe(self, key_expr: str, listen: Listen) -> Handle:
        """See Bus."""
        return self._declare(self._hub.subscribers, (key_expr, listen))

    def declare_alive(self, key: str) -> Handle:
        """See Bus."""
        return self._declare(self._hub.tokens, key)

    def alive(self, key_expr: str, *, timeout_s: float = 2.0) -> list[str]:
        """See Bus."""
        with self._hub.lock:
            return sorted({key for key in self._hub.tokens if self._hub.reachable and key_matches(key_expr, key)})

    def connected(self) -> bool:
        """See Bus."""
        return self._hub.reachable and self._hub.members > 1 and not self.closed()

    def closed(self) -> bool:
        """See Bus."""
        return self._handles is None

    def close(self) -> None:
        """See Bus."""
        handles, self._handles = self._handles, None
        if handles is not None:
            self._hub.members -= 1
            for handle in handles:
                handle.close()

    def _declare(self, table: list[Any], entry: Any) -> Handle:
        if self._handles is None:
            raise LinkError("this bus is closed; open another one")
        with self._hub.lock:
            table.append(entry)

        def undo() -> None:
            with self._hub.lock:
                table.remove(entry)

        handle = Handle(undo)
        self._handles = [*(other for other in self._handles if not other.closed()), handle]
        return handle
