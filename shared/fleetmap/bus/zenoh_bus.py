"""The bus between server and robots: query, reply, publish, subscribe, liveliness. The only module that uses zenoh's API."""

import json
import logging
import resource
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import partial
from operator import methodcaller
from typing import Any, Literal, Self

import zenoh

from fleetmap.access import Access
from fleetmap.bus.endpoints import TlsFiles, check_endpoint, has_tls, with_free_port
from fleetmap.bus.fair_queue import FairQueue, sender_of
from fleetmap.errors import FleetmapError, LinkError, UnreachableError, UsageError

Answer = Callable[[str, bytes], bytes]
"""Returns the reply to a query (key, payload); a FleetmapError is sent back as an error reply."""

Listen = Callable[[str, bytes], None]
"""Receives (key, payload) of a publication. Runs on a thread of the bus."""

MAX_MESSAGE_BYTES = 1 << 20  # larger content is sent in parts, because one large message delays all others behind it
_RETRY_S = 0.05
_REOPEN_WITHIN_S = 10.0
_MAX_ALIVE, _ALIVE_WITHIN_S = 1 << 17, 2.0
_MAX_SESSIONS = 20_000  # zenoh's default is 1000: further robots would get no response
# Connections without a session yet, each for at most 10 s. At zenoh's default, 100, so many silent ones would shut out all robots.
_MAX_PENDING = 4096
_MAX_RECEIVED_BYTES = 2 * MAX_MESSAGE_BYTES
_BUSY = b"later: too much of this sender is waiting already"
_log = logging.getLogger(__name__)


Handle = ExitStack
"""A declaration on the bus; ends with `close`, of which a second call does nothing, or with the bus."""


@dataclass(eq=False)
class _Declaration:
    """A declaration: function that declares it on a session, and one that ends its resources; zenoh's object for it."""

    declare: Callable[[Any], Any]
    stop: Callable[[], None]
    current: Any = None


class Bus(AbstractContextManager["Bus"]):
    """One participant, a zenoh session with explicit endpoints only: no multicast, no gossip, no discovery.

    Must be closed, best as a context manager. Messages hold at most MAX_MESSAGE_BYTES. Queries, replies and publications block while
    the network is congested, unless they may be dropped. A server's incoming messages pass a `FairQueue`: those of a flooding sender are
    dropped. A robot receives everything that it subscribed to. A server's session can be reopened with other rules;
    declarations are then repeated.
    """

    def __init__(
        self, endpoint: str, *, is_server: bool = False, tls: TlsFiles | None = None, access: Access | None = None
    ) -> None:
        """Create a closed bus: see `open`. tls: mutual TLS; access: rules of a server with mutual TLS.

        Raises UsageError for an invalid endpoint and for TLS without its files.
        """
        self.endpoint = check_endpoint(endpoint)
        if has_tls(endpoint) and tls is None and is_server:
            raise UsageError(f"endpoint {endpoint}: listening with TLS needs a certificate")
        self._is_server, self._tls, self.access = is_server, tls, access
        self._lock = threading.RLock()
        self._session: Any = None
        self._is_closed = False
        # A declaration lives as long as its object: without this list a token would vanish with a discarded handle.
        self._declared: list[_Declaration] = []

    def open(self) -> Self:
        """Open the session with all declarations so far, and return the bus; raises LinkError if it cannot listen or connect.

        A robot connects, and reconnects after every loss, in the background. A server's port 0 takes a free one: see `endpoint`.
        """
        wanted = self.endpoint
        with self._lock:
            for attempt in range(5):
                self.endpoint = with_free_port(wanted)
                try:
                    self._open()
                    break
                except zenoh.ZError as error:
                    if not self._is_server:
                        raise LinkError(f"cannot connect to {wanted} ({error}); check the endpoint") from error
                    # Between finding a free port and listening on it another process may take it.
                    if self.endpoint == wanted or attempt == 4:
                        raise LinkError(
                            f"cannot listen on {wanted} ({error}); is another server running there?"
                        ) from error
        return self

    def reopen(self, access: Access) -> None:
        """Reopen a server's session with these rules and the current certificate: zenoh reads both only when it opens.

        Robots reconnect by themselves; calls on other threads wait. Raises LinkError if that fails: the session
        stays as it is if a certificate cannot be used, and otherwise is closed until another attempt succeeds.
        """
        if self._tls is not None and (fault := self._tls.fault()):
            raise LinkError(f"{fault}; the bus stays as it is")
        with self._lock:
            if self._is_closed:
                return
            if self._session is not None and not self._session.is_closed():
                self._session.close()
            self.access = access
            give_up_s = time.monotonic() + _REOPEN_WITHIN_S
            while True:
                try:
                    self._open()
                    return
                except zenoh.ZError as error:
                    # The port of QUIC is not free immediately after its session is closed.
                    if time.monotonic() > give_up_s:
                        raise LinkError(f"cannot listen on {self.endpoint} again ({error}); trying on") from error
                    time.sleep(_RETRY_S)

    def __exit__(self, *_: object) -> None:
        self.close()

    def queryable(self, key_expr: str, answer: Answer) -> Handle:
        """Answer queries for keys that match `key_expr` (`*` is one chunk, `**` any number)."""

        def reply(query: Any, key: str) -> None:
            # Leaving the block ends the query: without it the client would wait for its timeout.
            with query:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                data, reason = answer_query(answer, key, payload)
                try:
                    if data is None:
                        query.reply_err(reason.encode("utf-8", "replace"))
                    else:
                        query.reply(key, data)
                except zenoh.ZError as error:
                    _log.debug("the session that asked for %r is gone: %s", key[:200], error)  # the client retries

        def take(query: Any) -> None:
            key = str(query.key_expr)
            size = _size(query, key) + len(str(query.parameters))
            question = key, hash(b"" if query.payload is None else query.payload.to_bytes())
            if not queue.put(sender_of(key), size, partial(reply, query, key), question):
                with query:
                    query.reply_err(_BUSY)

        if not self._is_server:
            plain = lambda query: reply(query, str(query.key_expr))  # noqa: E731
            return self._declare(lambda session: session.declare_queryable(key_expr, plain, complete=True))
        queue = FairQueue(f"answers {key_expr}")
        direct = zenoh.handlers.Callback(take, lambda: None, indirect=False)
        return self._declare(lambda session: session.declare_queryable(key_expr, direct, complete=True), queue.close)

    def get(self, key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        """Return the first reply to a query; repeats it until the timeout, because zenoh does not reply before a connection stands.

        Raises UnreachableError without a reply within `timeout_s`, LinkError with the reason if the other side refuses.
        """
        check_size(payload, key)
        deadline = time.monotonic() + timeout_s
        while (left_s := deadline - time.monotonic()) > 0:
            # The reply inherits the query's congestion control; dropping would lose large replies.
            how = {"timeout": left_s, "payload": payload, "congestion_control": zenoh.CongestionControl.BLOCK}
            refusals = []
            for reply in self._guarded(methodcaller("get", key, **how)):
                if reply.ok is not None:
                    return bytes(reply.ok.payload.to_bytes())
                refusals.append(reply.err.payload.to_string())
            if (refusal := next((reason for reason in refusals if reason != "Timeout"), None)) is not None:
                raise LinkError(f"{key} was refused: {refusal}")
            time.sleep(min(_RETRY_S, max(0.0, deadline - time.monotonic())))
        raise no_answer(key, self.endpoint, timeout_s, is_silenced=self._tls is not None and self.connected())

    def publish(self, key: str, payload: bytes, *, may_drop: bool = False) -> None:
        """Publish to all subscribers; having none is not an error. `may_drop`: drop the message on a congested network."""
        control = zenoh.CongestionControl.DROP if may_drop else zenoh.CongestionControl.BLOCK
        check_size(payload, key)
        self._guarded(lambda session: session.put(key, payload, congestion_control=control))

    def subscribe(self, key_expr: str, listen: Listen) -> Handle:
        """Call `listen` for every publication under matching keys."""

        def take(sample: Any) -> None:
            key = str(sample.key_expr)
            size = _size(sample, key)
            if size <= MAX_MESSAGE_BYTES:
                queue.put(sender_of(key), size, lambda: deliver(listen, key, sample.payload.to_bytes()))

        if not self._is_server:
            plain = lambda sample: deliver(listen, str(sample.key_expr), sample.payload.to_bytes())  # noqa: E731
            return self._declare(lambda session: session.declare_subscriber(key_expr, plain))
        queue = FairQueue(f"hears {key_expr}")
        direct = zenoh.handlers.Callback(take, lambda: None, indirect=False)
        return self._declare(lambda session: session.declare_subscriber(key_expr, direct), queue.close)

    def declare_alive(self, key: str) -> Handle:
        """Declare a liveliness token under `key` until the handle or the bus is closed, or the process dies."""
        return self._declare(lambda session: session.liveliness().declare_token(key))

    def alive(self, key_expr: str) -> list[str]:
        """Keys of all live tokens, sorted."""
        # A router replies from its own table before `get` returns: a full channel would block it forever.
        channel: Any = zenoh.handlers.FifoChannel(_MAX_ALIVE)
        replies = self._guarded(lambda session: session.liveliness().get(key_expr, channel, timeout=_ALIVE_WITHIN_S))
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def certificates(self) -> list[str]:
        """Certificate names of the connections to a server with mutual TLS, sorted, one per connection."""
        links = self._guarded(lambda session: session.info.links())
        return sorted(link.auth_identifier for link in links if link.auth_identifier)

    def connected(self) -> bool:
        """True if any other participant can be reached now."""
        session = self._session
        if session is None or session.is_closed():
            return False
        return bool(session.info.routers_zid() or session.info.peers_zid())

    def closed(self) -> bool:
        """True once this participant was closed."""
        return self._is_closed

    def close(self) -> None:
        """Undeclare everything; a second call does nothing. Without it the process would hang at exit."""
        with self._lock:
            declared, self._declared, self._is_closed = self._declared, [], True
            if self._session is not None and not self._session.is_closed():
                self._session.close()
        for entry in declared:
            entry.stop()

    def _open(self) -> None:
        """Open a new session with all declarations. The caller holds the lock."""
        way: Literal["listen", "connect"] = "listen" if self._is_server else "connect"
        entries: dict[str, Any] = {f"{way}/endpoints": [self.endpoint]}
        if self._tls is not None:
            entries["transport/link/tls"] = self._tls.config(way)
        if self._is_server:
            files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            entries |= _SERVER | {"transport/unicast/accept_pending": min(_MAX_PENDING, files // 4)}
            if self.access is not None:
                entries |= {"transport/link/rx/max_message_size": _MAX_RECEIVED_BYTES, **self.access.zenoh_config()}
        self._session = zenoh.open(_config(entries))
        for entry in self._declared:
            entry.current = entry.declare(self._session)

    def _declare(self, declare: Callable[[Any], Any], stop: Callable[[], None] = lambda: None) -> Handle:
        declared = _Declaration(declare, stop)
        with self._lock:
            if self._session is not None:
                declared.current = self._guarded(declare)
            self._declared.append(declared)
        handle = Handle()
        handle.callback(self._undeclare, declared)
        return handle

    def _undeclare(self, declared: _Declaration) -> None:
        with self._lock:
            if declared in self._declared:
                self._declared.remove(declared)
                if declared.current is not None and not self._session.is_closed():
                    declared.current.undeclare()
        declared.stop()

    def _guarded(self, call: Callable[[Any], Any]) -> Any:
        while True:
            with self._lock:
                session = self._session
            if session is None:
                raise LinkError(f"the bus at {self.endpoint} is not open yet")
            try:
                return call(session)
            except zenoh.ZError as error:
                with self._lock:
                    if session is self._session or self._is_closed:
                        raise LinkError(f"the bus at {self.endpoint} refused ({error}); is it closed?") from error


def answer_query(answer: Answer, key: str, payload: bytes) -> tuple[bytes | None, str]:
    """Return the reply, or None and the reason. An error in the handler is logged and sent to the client, which waits for a reply."""
    try:
        return check_size(answer(key, payload), key), ""
    except FleetmapError as error:
        return None, str(error)
    except Exception as error:
        _log.exception("answering %r failed", key[:200])
        return None, f"internal error of the other side ({type(error).__name__}); its log says more"


def check_size(payload: bytes, key: str) -> bytes:
    """Return `payload`; raise LinkError if it is too large for a message."""
    if len(payload) > MAX_MESSAGE_BYTES:
        raise LinkError(
            f"{len(payload)} bytes under {key} are more than the {MAX_MESSAGE_BYTES} of a message; use parts"
        )
    return payload


def deliver(listen: Listen, key: str, payload: bytes) -> None:
    """Call a subscriber. Its exceptions are logged and do not reach the publisher."""
    try:
        listen(key, payload)
    except Exception:
        _log.exception("the subscriber for %r failed", key[:200])


def no_answer(key: str, endpoint: str, timeout_s: float, *, is_silenced: bool = False) -> UnreachableError:
    """Error of a query without a reply. is_silenced: a server is there, and it knows the client's certificate."""
    why = "is the server running and reachable?"
    if is_silenced:
        why = (
            "the server is there and lets this certificate say nothing: revoked, enrolled anew, or of another site? "
            "`mapserver robots list` shows it"
        )
    return UnreachableError(f"no reply for {key} from {endpoint} within {timeout_s:g} s; {why}")


def _size(message: Any, key: str) -> int:
    """Memory of a waiting sample or query, attachment included."""
    parts = (message.payload, message.attachment)
    return len(key) + sum(len(part) for part in parts if part is not None)


_COMMON: dict[str, Any] = {
    # In peer mode, without timeout and without exit on failure, `open` returns at once and connects in the background
    # forever; any other combination gives up or blocks.
    "mode": "peer",
    "listen/endpoints": [],
    "connect/endpoints": [],
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
    "scouting/delay": 1,
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/shared_memory/enabled": False,
    "adminspace/enabled": False,
}
_SERVER: dict[str, Any] = {"mode": "router", "transport/unicast/max_sessions": _MAX_SESSIONS}


def _config(entries: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in (_COMMON | entries).items():
        config.insert_json5(key, json.dumps(value))
    return config
