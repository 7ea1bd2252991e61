"""The bus over zenoh, which is used here alone."""

import json
import socket
import time
from collections.abc import Callable
from functools import partial
from ipaddress import ip_address
from typing import Any, Self

import zenoh

from fleetmap.bus.fair_queue import FairQueue, sender_of
from fleetmap.bus.protocol import (
    MAX_MESSAGE_BYTES,
    Answer,
    Bus,
    Handle,
    Listen,
    answer_query,
    check_size,
    deliver,
    no_answer,
    query_refused,
)
from fleetmap.errors import LinkError, UsageError

_RETRY_S = 0.05
_MAX_ALIVE = 1 << 17
_BUSY = b"later: too much of this sender is waiting already"


class ZenohBus(Bus):
    """A zenoh session with explicit endpoints only: no multicast, no gossip, nothing found by itself.

    What a server hears passes a `FairQueue`: one sender who floods is dropped. Whoever connects hears all that he asked for.
    """

    def __init__(self, session: Any, endpoint: str, *, is_server: bool = False) -> None:
        self._session = session
        self._is_server = is_server
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
                return cls(_open("router", listen=actual), actual, is_server=True)
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

        def reply(query: Any, key: str) -> None:
            # Leaving the block ends the question: without it the asker would wait for its timeout.
            with query:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                data, reason = answer_query(answer, key, payload)
                if data is None:
                    query.reply_err(reason.encode("utf-8", "replace"))
                else:
                    query.reply(key, data)

        def take(query: Any) -> None:
            key = str(query.key_expr)
            size = _size(query, key) + len(str(query.parameters))
            if not queue.put(sender_of(key), size, partial(reply, query, key)):
                with query:
                    query.reply_err(_BUSY)

        if not self._is_server:
            plain = lambda query: reply(query, str(query.key_expr))  # noqa: E731
            return self._handle(lambda: self._session.declare_queryable(key_expr, plain, complete=True))
        queue = FairQueue(f"answers {key_expr}")
        direct = zenoh.handlers.Callback(take, queue.close, indirect=False)
        return self._handle(lambda: self._session.declare_queryable(key_expr, direct, complete=True))

    def get(self, key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        """See Bus. Asks again until the time is over, because before a connection stands zenoh answers with silence."""
        check_size(payload, key)
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
                raise query_refused(key, refusals[0])
            time.sleep(min(_RETRY_S, max(0.0, deadline - time.monotonic())))
        raise no_answer(key, timeout_s)

    def publish(self, key: str, payload: bytes, *, may_drop: bool = False, attachment: bytes = b"") -> None:
        """See Bus."""
        control = zenoh.CongestionControl.DROP if may_drop else zenoh.CongestionControl.BLOCK
        put = partial(self._session.put, key, check_size(payload, key), congestion_control=control)
        self._guarded(partial(put, attachment=attachment) if attachment else put)

    def subscribe(self, key_expr: str, listen: Listen) -> Handle:
        """See Bus."""

        def take(sample: Any) -> None:
            key = str(sample.key_expr)
            size = _size(sample, key)
            if size <= MAX_MESSAGE_BYTES:
                queue.put(sender_of(key), size, lambda: deliver(listen, key, sample.payload.to_bytes()))

        if not self._is_server:
            plain = lambda sample: deliver(listen, str(sample.key_expr), sample.payload.to_bytes())  # noqa: E731
            return self._handle(lambda: self._session.declare_subscriber(key_expr, plain))
        queue = FairQueue(f"hears {key_expr}")
        direct = zenoh.handlers.Callback(take, queue.close, indirect=False)
        return self._handle(lambda: self._session.declare_subscriber(key_expr, direct))

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


def is_loopback(endpoint: str) -> bool:
    """Whether nobody but this machine is at an endpoint."""
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def _size(message: Any, key: str) -> int:
    """What a sample or question keeps in memory while it waits: what came beside its payload too."""
    parts = (message.payload, message.attachment)
    return len(key) + sum(len(part) for part in parts if part is not None)


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
