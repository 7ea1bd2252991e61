"""The contract of the bus: query, answer, publish, subscribe, presence; and what all its implementations share."""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Self

from fleetmap.errors import FleetmapError, LinkError, UnreachableError

Answer = Callable[[str, bytes], bytes]
"""Bytes that answer the question (key, payload); a FleetmapError that it raises travels back as the answer's error."""

Listen = Callable[[str, bytes], None]
"""Takes (key, payload) of what was published. Runs on a thread of the bus."""

Attach = Callable[[bytes], bytes]
"""The attachment of an answer, by that of its question; empty for none."""

MAX_MESSAGE_BYTES = 1 << 20  # larger content is sent in parts, because one large message delays all others behind it
MAX_LATCHED_BYTES = 1 << 26  # a robot's own programs take a map in one message

_log = logging.getLogger(__name__)


class Handle:
    """Something declared on the bus; `close` takes it back, as does closing the bus."""

    def __init__(self, undo: Callable[[], None]) -> None:
        self._undo: Callable[[], None] | None = undo

    def closed(self) -> bool:
        """Whether it was taken back."""
        return self._undo is None

    def close(self) -> None:
        """Takes it back; a second call does nothing."""
        undo, self._undo = self._undo, None
        if undo is not None:
            undo()


class LatchedPublisher(Handle):
    """Publishes under one key, and keeps the last message for subscribers who come later and ask for it."""

    def __init__(self, put: Callable[[bytes, bytes], None], undo: Callable[[], None]) -> None:
        super().__init__(undo)
        self._put = put

    def put(self, payload: bytes, attachment: bytes = b"") -> None:
        """Publishes; LinkError for more than MAX_LATCHED_BYTES, or on a closed bus."""
        if len(payload) > MAX_LATCHED_BYTES:
            raise LinkError(
                f"{len(payload)} bytes are more than the {MAX_LATCHED_BYTES} that are kept for late subscribers"
            )
        self._put(payload, attachment)


class Bus(ABC):
    """One participant. Must be closed, best as a context manager. Messages hold at most MAX_MESSAGE_BYTES.

    Questions, answers and publications block while the network is full, rather than being lost, unless they may be.
    """

    @abstractmethod
    def queryable(self, key_expr: str, answer: Answer, attach: Attach | None = None) -> Handle:
        """Answers questions for keys that match `key_expr` (`*` is one chunk, `**` any number)."""

    @abstractmethod
    def get(self, key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        """The first answer to a question.

        Raises UnreachableError when nobody answers within `timeout_s`, LinkError with the reason when the other side
        refuses.
        """

    @abstractmethod
    def publish(self, key: str, payload: bytes, *, may_drop: bool = False, attachment: bytes = b"") -> None:
        """Tells all subscribers; nobody there is no error. `may_drop` loses it rather than wait for a full network.

        attachment: beside the payload, for what other programs want there; no subscriber of this class is shown it.
        """

    @abstractmethod
    def latched_publisher(self, key: str) -> LatchedPublisher:
        """A publisher under `key` that keeps its last message."""

    @abstractmethod
    def session_id(self) -> str:
        """Names this participant on its network."""

    @abstractmethod
    def subscribe(self, key_expr: str, listen: Listen, *, is_latched: bool = False) -> Handle:
        """Calls `listen` for everything that is published under keys that match; is_latched: first for what latched publishers keep."""

    @abstractmethod
    def declare_alive(self, key: str) -> Handle:
        """Shows this participant's presence under `key` until the handle or the bus is closed, or the process dies."""

    @abstractmethod
    def alive(self, key_expr: str, *, timeout_s: float = 2.0) -> list[str]:
        """Keys under which somebody is present, sorted."""

    @abstractmethod
    def connected(self) -> bool:
        """Whether anybody else can be reached now."""

    @abstractmethod
    def closed(self) -> bool:
        """Whether this participant was closed."""

    @abstractmethod
    def close(self) -> None:
        """Takes everything back that was declared here; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def answer_query(answer: Answer, key: str, payload: bytes) -> tuple[bytes | None, str]:
    """The answer, or None and the reason. A fault in the handler reaches the log and the client, which waits for an answer."""
    try:
        return check_size(answer(key, payload), key), ""
    except FleetmapError as error:
        return None, str(error)
    except Exception as error:
        _log.exception("answering %r failed", key[:200])
        return None, f"internal error of the other side ({type(error).__name__}); its log says more"


def check_size(payload: bytes, key: str) -> bytes:
    """`payload` itself; raises LinkError for one that no message holds."""
    if len(payload) > MAX_MESSAGE_BYTES:
        raise LinkError(
            f"{len(payload)} bytes under {key} are more than the {MAX_MESSAGE_BYTES} of a message; use parts"
        )
    return payload


def deliver(listen: Listen, key: str, payload: bytes) -> None:
    """Calls a subscriber. What it raises is logged and does not reach the publisher."""
    try:
        listen(key, payload)
    except Exception:
        _log.exception("the subscriber for %r failed", key[:200])


def no_answer(key: str, timeout_s: float, *, is_silenced: bool = False) -> UnreachableError:
    """The error of a query without an answer. is_silenced: a server is there, and it knows the asker's certificate."""
    why = "is the server running and reachable?"
    if is_silenced:
        why = (
            "the server is there and lets this certificate say nothing: revoked, enrolled anew, or of another site? "
            "`mapserver robots list` shows it"
        )
    return UnreachableError(f"nobody answered for {key} within {timeout_s:g} s; {why}")


def query_refused(key: str, reason: str) -> LinkError:
    """The error of a query that the other side refused."""
    return LinkError(f"{key} was refused: {reason}")
