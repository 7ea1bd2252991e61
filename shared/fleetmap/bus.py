"""The bus between server and robots: ask, answer, publish, subscribe, presence. Zenoh lives here alone.

`MemoryBus` is the same thing inside one process, for tests and for replays without a server.
"""

import json
import logging
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, Self

import zenoh

from fleetmap.errors import FleetmapError, LinkError, UnreachableError, UsageError

Answer = Callable[[str, bytes], bytes]
"""Bytes that answer the question (key, payload); a FleetmapError that it raises travels back as the answer's error."""

Listen = Callable[[str, bytes], None]
"""Takes (key, payload) of what was published. Runs on a thread of the bus."""

MAX_MESSAGE_BYTES = 1 << 20  # whatever is larger travels in parts: one large message stops all others behind it

_log = logging.getLogger(__name__)
_RETRY_S = 0.05
_MAX_ALIVE = 1 << 17


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


class Bus(ABC):
    """One participant. Must be closed, best as a context manager. Messages hold at most MAX_MESSAGE_BYTES.

    Questions, answers and publications block while the network is full, rather than being lost, unless they may be.
    """

    @abstractmethod
    def queryable(self, key_expr: str, answer: Answer) -> Handle:
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
    def subscribe(self, key_expr: str, listen: Listen) -> Handle:
        """Calls `listen` for everything that is published under keys that match."""

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


def key_matches(key_expr: str, key: str) -> bool:
    """Whether the key expression (chunks may be `*` or `**`) includes the plain key."""
    return _chunks_match(key_expr.split("/"), key.split("/"))


def _chunks_match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    if pattern[0] == "**":
        return any(_chunks_match(pattern[1:], chunks[skip:]) for skip in range(len(chunks) + 1))
    return bool(chunks) and pattern[0] in {"*", chunks[0]} and _chunks_match(pattern[1:], chunks[1:])


def _answered(answer: Answer, key: str, payload: bytes) -> tuple[bytes | None, str]:
    """The answer, or None and the reason. A fault in the handler must reach the asker, who waits, and the log."""
    try:
        return _small(answer(key, payload), key), ""
    except FleetmapError as error:
        return None, str(error)
    except Exception as error:
        _log.exception("answering %s failed", key)
        return None, f"internal error of the other side ({type(error).__name__}); its log says more"


def _small(payload: bytes, key: str) -> bytes:
    """`payload` itself; raises LinkError for one that no message holds."""
    if len(payload) > MAX_MESSAGE_BYTES:
        raise LinkError(
            f"{len(payload)} bytes under {key} are more than the {MAX_MESSAGE_BYTES} of a message; use parts"
        )
    return payload


def _heard(listen: Listen, key: str, payload: bytes) -> None:
    """Calls a subscriber; what it raises ends here, in the log, because the publisher must not suffer for it."""
    try:
        listen(key, payload)
    except Exception:
        _log.exception("the subscriber for %s failed", key)


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
        _small(payload, key)
        with self._hub.lock:
            answers = [answer for key_expr, answer in self._hub.queryables if key_matches(key_expr, key)]
        if not self._hub.reachable or not answers:
            raise _nobody(key, timeout_s)
        data, reason = _answered(answers[0], key, payload)
        if data is None:
            raise _refused(key, reason)
        return data

    def publish(self, key: str, payload: bytes, *, may_drop: bool = False, attachment: bytes = b"") -> None:
        """See Bus."""
        _small(payload, key)
        with self._hub.lock:
            listeners = [listen for key_expr, listen in self._hub.subscribers if key_matches(key_expr, key)]
        for listen in listeners if self._hub.reachable else []:
            _heard(listen, key, payload)

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


class ZenohBus(Bus):
    """A zenoh session with explicit endpoints only: no multicast, no gossip, nothing found by itself."""

    def __init__(self, session: Any, endpoint: str) -> None:
        self._session = session
        self.endpoint = endpoint
        # What is declared lives as long as its object: without this list a token would vanish with an ignored handle.
        self._handles: list[Handle] = []

    @classmethod
    def listen(cls, endpoint: str) -> Self:
        """The server's side, a router that robots connect to. Port 0 takes a free one: see `endpoint`.

        Raises UsageError for something that is no endpoint, LinkError where it cannot listen.
        """
        wanted = check_endpoint(endpoint)
        for attempt in range(5):
            actual = _with_free_port(wanted)
            try:
                return cls(_open("router", listen=actual), actual)
            except zenoh.ZError as error:
                # Between finding a free port and listening on it another process may take it.
                if actual == wanted or attempt == 4:
                    raise LinkError(f"cannot listen on {wanted} ({error}); is another server running there?") from error
        raise AssertionError("unreachable")

    @classmethod
    def connect(cls, endpoint: str) -> Self:
        """A robot's side. Returns at once; connects, and after every loss connects again, in the background."""
        try:
            return cls(_open("peer", connect=check_endpoint(endpoint)), endpoint)
        except zenoh.ZError as error:
            raise LinkError(f"cannot connect to {endpoint} ({error}); check the endpoint") from error

    def queryable(self, key_expr: str, answer: Answer) -> Handle:
        """See Bus."""

        def reply(query: Any) -> None:
            # Leaving the block ends the question: without it the asker would wait for its timeout.
            with query:
                key = str(query.key_expr)
                payload = b"" if query.payload is None else query.payload.to_bytes()
                data, reason = _answered(answer, key, payload)
                if data is None:
                    query.reply_err(reason.encode())
                else:
                    query.reply(key, data)

        return self._handle(lambda: self._session.declare_queryable(key_expr, reply, complete=True))

    def get(self, key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        """See Bus. Asks again until the time is over, because before a connection stands zenoh answers with silence."""
        _small(payload, key)
        deadline = time.monotonic() + timeout_s
        while (left_s := deadline - time.monotonic()) > 0:
            # The answer travels with the question's congestion control; what may be dropped would lose large answers.
            ask = partial(self._session.get, key, timeout=left_s, payload=payload)
            replies = self._guarded(partial(ask, congestion_control=zenoh.CongestionControl.BLOCK))
            reasons = []
            for reply in replies:
                if reply.ok is not None:
                    return bytes(reply.ok.payload.to_bytes())
                reasons.append(reply.err.payload.to_string())
            refusals = [reason for reason in reasons if reason != "Timeout"]
            if refusals:
                raise _refused(key, refusals[0])
            time.sleep(min(_RETRY_S, max(0.0, deadline - time.monotonic())))
        raise _nobody(key, timeout_s)

    def publish(self, key: str, payload: bytes, *, may_drop: bool = False, attachment: bytes = b"") -> None:
        """See Bus."""
        control = zenoh.CongestionControl.DROP if may_drop else zenoh.CongestionControl.BLOCK
        put = partial(self._session.put, key, _small(payload, key), congestion_control=control)
        self._guarded(partial(put, attachment=attachment) if attachment else put)

    def subscribe(self, key_expr: str, listen: Listen) -> Handle:
        """See Bus."""

        def take(sample: Any) -> None:
            _heard(listen, str(sample.key_expr), sample.payload.to_bytes())

        return self._handle(lambda: self._session.declare_subscriber(key_expr, take))

    def declare_alive(self, key: str) -> Handle:
        """See Bus."""
        return self._handle(lambda: self._session.liveliness().declare_token(key))

    def alive(self, key_expr: str, *, timeout_s: float = 2.0) -> list[str]:
        """See Bus."""
        # A router answers from its own table before `get` returns: what the channel does not hold would stop it for ever.
        channel: Any = zenoh.handlers.FifoChannel(_MAX_ALIVE)
        replies = self._guarded(lambda: self._session.liveliness().get(key_expr, channel, timeout=timeout_s))
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def connected(self) -> bool:
        """See Bus."""
        if self.closed():
            return False
        return bool(self._session.info.routers_zid() or self._session.info.peers_zid())

    def closed(self) -> bool:
        """See Bus."""
        return bool(self._session.is_closed())

    def close(self) -> None:
        """See Bus. Without it the process would hang at its end."""
        if not self.closed():
            self._session.close()

    def _handle(self, declare: Callable[[], Any]) -> Handle:
        declared = self._guarded(declare)

        def undo() -> None:
            if not self.closed():
                declared.undeclare()

        handle = Handle(undo)
        self._handles = [*(other for other in self._handles if not other.closed()), handle]
        return handle

    def _guarded(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except zenoh.ZError as error:
            raise LinkError(f"the bus at {self.endpoint} refused ({error}); is it closed?") from error


def check_endpoint(endpoint: str) -> str:
    """`endpoint` itself; raises UsageError unless it reads like tcp/HOST:PORT (also tls, quic, udp)."""
    protocol, slash, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if not slash or protocol not in {"tcp", "tls", "quic", "udp"} or not host or not port.isdecimal():
        raise UsageError(f"endpoint {endpoint!r}: write it like tcp/127.0.0.1:7447")
    if int(port) > 65535:
        raise UsageError(f"endpoint {endpoint!r}: port {port} is above 65535")
    return endpoint


def _with_free_port(endpoint: str) -> str:
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if port != "0":
        return endpoint
    family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.bind((host.strip("[]"), 0))
        return f"{protocol}/{host}:{probe.getsockname()[1]}"


def _open(mode: str, *, listen: str | None = None, connect: str | None = None) -> Any:
    config = zenoh.Config()
    for key, value in (
        ("mode", mode),
        ("listen/endpoints", [] if listen is None else [listen]),
        ("connect/endpoints", [] if connect is None else [connect]),
        # In peer mode, without an end and without failure, `open` returns at once and connects in the background for
        # ever; any other combination gives up, or waits.
        ("connect/timeout_ms", -1),
        ("connect/exit_on_failure", False),
        ("connect/retry", {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 2}),
        ("scouting/delay", 1),
        ("scouting/multicast/enabled", False),
        ("scouting/gossip/enabled", False),
        ("transport/shared_memory/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _nobody(key: str, timeout_s: float) -> UnreachableError:
    return UnreachableError(f"nobody answered for {key} within {timeout_s:g} s; is the server running and reachable?")


def _refused(key: str, reason: str) -> LinkError:
    return LinkError(f"{key} was refused: {reason}")
