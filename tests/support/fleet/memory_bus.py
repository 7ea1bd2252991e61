"""The bus inside one process; obeys the rules of `fleetmap.access`, as zenoh does."""

import threading
from typing import Any

import zenoh

from fleetmap.access import Access, Act, Direction, _rules
from fleetmap.bus import zenoh_bus
from fleetmap.errors import LinkError


class MemoryHub:
    """Shared state of MemoryBus participants. `reachable` False simulates a network outage.

    access: rules for participants with a certificate, as a server's session has them; may be replaced at any time.
    """

    def __init__(self, access: Access | None = None) -> None:
        self.reachable = True
        self.access = access
        self.lock = threading.RLock()
        self.queryables: list[tuple[str, zenoh_bus.Answer, str | None]] = []
        self.subscribers: list[tuple[str, zenoh_bus.Listen, str | None]] = []
        self.tokens: list[tuple[str, str | None]] = []
        self.certificates: list[str | None] = []  # of all participants, None for the server

    def passes(self, certificate: str | None, flow: Direction, act: Act, key_expr: str) -> bool:
        """True if a message of or for a participant passes; the server itself (None) is not restricted."""
        if self.access is None or certificate is None:
            return True
        return permits(self.access, certificate, flow, act, key_expr)


class MemoryBus(zenoh_bus.Bus):
    """A participant of a MemoryHub; callbacks run on the caller's thread.

    As on the network, denied messages are dropped silently: no error, no delivery.
    """

    endpoint = "tls/0.0.0.0:7447"

    def __init__(self, hub: MemoryHub, certificate: str | None = None) -> None:
        """certificate: its common name; None for the server."""
        self._hub, self._certificate = hub, certificate
        self._handles: list[zenoh_bus.Handle] | None = []
        hub.certificates.append(certificate)

    def queryable(self, key_expr: str, answer: zenoh_bus.Answer) -> zenoh_bus.Handle:
        return self._declare(self._hub.queryables, (key_expr, answer, self._certificate))

    def get(self, key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        """See Bus; never waits."""
        zenoh_bus.check_size(payload, key)
        hub, own = self._hub, self._certificate
        with hub.lock:
            answers = [
                answer
                for key_expr, answer, other in hub.queryables
                if key_includes(key_expr, key)
                and hub.passes(other, "ingress", "declare_queryable", key_expr)
                and hub.passes(other, "egress", "query", key)
                and hub.passes(other, "ingress", "reply", key)
            ]
        may_ask = hub.passes(own, "ingress", "query", key) and hub.passes(own, "egress", "reply", key)
        if not hub.reachable or not answers or not may_ask:
            raise zenoh_bus.no_answer(
                key, self.endpoint, timeout_s, is_silenced=hub.access is not None and own is not None
            )
        data, reason = zenoh_bus.answer_query(answers[0], key, payload)
        if data is None:
            raise LinkError(f"{key} was refused: {reason}")
        return data

    def publish(self, key: str, payload: bytes, *, may_drop: bool = False) -> None:
        zenoh_bus.check_size(payload, key)
        hub = self._hub
        with hub.lock:
            listeners = [
                listen
                for key_expr, listen, other in hub.subscribers
                if key_includes(key_expr, key)
                and hub.passes(other, "ingress", "declare_subscriber", key_expr)
                and hub.passes(other, "egress", "put", key)
            ]
        if hub.reachable and hub.passes(self._certificate, "ingress", "put", key):
            for listen in listeners:
                zenoh_bus.deliver(listen, key, payload)

    def subscribe(self, key_expr: str, listen: zenoh_bus.Listen) -> zenoh_bus.Handle:
        return self._declare(self._hub.subscribers, (key_expr, listen, self._certificate))

    def declare_alive(self, key: str) -> zenoh_bus.Handle:
        return self._declare(self._hub.tokens, (key, self._certificate))

    def alive(self, key_expr: str, *, timeout_s: float = 2.0) -> list[str]:
        hub = self._hub
        if not hub.reachable or not hub.passes(self._certificate, "ingress", "liveliness_query", key_expr):
            return []
        with hub.lock:
            shown = {key for key, other in hub.tokens if hub.passes(other, "ingress", "liveliness_token", key)}
        return sorted(key for key in shown if key_includes(key_expr, key))

    def reopen(self, access: Access) -> None:
        """Set other rules for the hub; as Bus, whose session is reopened."""
        self._hub.access = access

    def certificates(self) -> list[str]:
        """Certificate names of the participants on the hub, sorted."""
        return sorted(name for name in self._hub.certificates if name)

    def connected(self) -> bool:
        return self._hub.reachable and len(self._hub.certificates) > 1 and not self.closed()

    def closed(self) -> bool:
        return self._handles is None

    def close(self) -> None:
        handles, self._handles = self._handles, None
        if handles is not None:
            self._hub.certificates.remove(self._certificate)
            for handle in handles:
                handle.close()

    def _declare(self, table: list[Any], entry: Any) -> zenoh_bus.Handle:
        if self._handles is None:
            raise LinkError("this bus is closed; open another one")
        with self._hub.lock:
            table.append(entry)

        def undo() -> None:
            with self._hub.lock:
                table.remove(entry)

        handle = zenoh_bus.Handle()
        handle.callback(undo)
        self._handles.append(handle)
        return handle


def permits(access: Access, certificate: str, flow: Direction, act: Act, key_expr: str) -> bool:
    """True if a message from (IN) or to (OUT) the holder of a certificate passes; `key_expr` may contain wildcards."""
    holder = access.holder(certificate)
    return holder is not None and any(
        flow is rule.flow and act in rule.acts and any(key_includes(key, key_expr) for key in rule.keys)
        for rule in _rules(holder)
    )


def key_includes(key_expr: str, other: str) -> bool:
    """True if a key expression includes every key that `other`, a key or key expression, matches."""
    return zenoh.KeyExpr(key_expr).includes(zenoh.KeyExpr(other))
