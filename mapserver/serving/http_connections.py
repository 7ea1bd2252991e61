"""Limits of HTTP connections, per address and in total, and of their duration."""

import asyncio
import logging
import resource
import socket
import struct
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import ip_address
from operator import itemgetter
from typing import Any, NamedTuple, NoReturn

from fleetmap.bus.endpoints import is_loopback_name
from fleetmap.log_lines import LogLimit

MAX_CONNECTIONS, MAX_OF_ADDRESS = 512, 64
MAX_HEAD_BYTES = 16 << 10
HEAD_S = 10.0  # until the headers are complete, also on a kept connection; and for the TLS handshake
BACKLOG = 256
_LOOK_EVERY_S = 1.0
_TAKEN_S, _TAKEN_BYTES = 30.0, 150_000  # a slower reader would occupy the server's memory
_BYTES_ACKED = 120  # offset of tcpi_bytes_acked in Linux's struct tcp_info
_PROXY = "a proxy"
_log = logging.getLogger(__name__)


def raise_file_limit() -> None:
    """Raise the process's limit of open files to its hard limit: the usual soft limit, 1024, is less than robots and strangers need."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


class BoundedListener(socket.socket):
    """A listening socket that closes connections above the limits at once.

    asyncio's own loop calls `accept` of this object; uvloop does not. Connections count from here on, before the TLS handshake.
    """

    def __init__(self, family: int, proxies: frozenset[str] = frozenset()) -> None:
        """proxies: addresses of proxies, which carry the requests of all users and have no limit of their own."""
        super().__init__(family, socket.SOCK_STREAM)
        self._proxies = proxies
        self._open: list[tuple[socket.socket, str, float]] = []  # with address, and time when it was opened
        self._refusals = LogLimit(_log)

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection; ConnectionAbortedError for one above the limits, which is closed.

        If all are in use, the oldest one of the busiest address is closed for one of an address with fewer.
        """
        connection, address = super().accept()
        host = _PROXY if plain_address(address[0]) in self._proxies else _network(address[0])
        self._open = [entry for entry in self._open if entry[0].fileno() >= 0]
        counts = Counter(other for _, other, _ in self._open if other != _PROXY)
        busiest, most = max(counts.items(), key=itemgetter(1), default=("", 0))
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        if counts[host] >= MAX_OF_ADDRESS:
            self._refuse(connection, f"{host} has {MAX_OF_ADDRESS} connections open")
        # File numbers are allocated from below: the last quarter is reserved for the store and the bus.
        elif len(self._open) >= MAX_CONNECTIONS or connection.fileno() >= limit - limit // 4:
            full = f"{len(self._open)} connections and about {connection.fileno()} of {limit} files are open"
            if most <= counts[host] + 1:
                self._refuse(connection, full)
            self._refusals.warning("full", "HTTP connections of %s are closed: %s", busiest, full)
            oldest = next(entry for entry in self._open if entry[1] == busiest)
            self._open.remove(oldest)
            _shut(oldest[0])
        self._open.append((connection, host, time.monotonic()))
        return connection, address

    def _refuse(self, connection: socket.socket, words: str) -> NoReturn:
        connection.close()
        self._refusals.warning("refused", "HTTP connections are refused: %s", words)
        raise ConnectionAbortedError(words)

    async def watch(self, protocols: set[Any]) -> None:
        """End connections without progress, for ever. protocols: uvicorn's, after their handshake."""
        marks: dict[Any, _Mark] = {}
        while True:
            await asyncio.sleep(_LOOK_EVERY_S)
            try:
                marks = self._look(marks, protocols)
            except Exception:
                _log.exception("the check for connections without progress failed")

    def _look(self, marks: "dict[Any, _Mark]", protocols: set[Any]) -> "dict[Any, _Mark]":
        now_s = time.monotonic()
        protocols = {protocol for protocol in protocols if _socket_of(protocol) is not None}
        marks = {protocol: _Mark.after(marks.get(protocol), protocol, now_s) for protocol in protocols}
        for protocol, mark in marks.items():
            most_s = _TAKEN_S if mark.state == "writes" else HEAD_S
            if mark.state != "answers" and now_s - mark.since_s > most_s:
                protocol.transport.abort()
        known = {held.fileno() for protocol in protocols if (held := _socket_of(protocol)) is not None}
        for connection, _, since_s in self._open:  # the others have not finished their handshake
            if connection.fileno() not in known and now_s - since_s > HEAD_S:
                _shut(connection)
        return marks


class _Mark(NamedTuple):
    """Start of a connection's present state. acked: bytes acknowledged by the client then."""

    state: object
    since_s: float
    acked: int

    @classmethod
    def after(cls, before: "_Mark | None", protocol: Any, now_s: float) -> "_Mark":
        state: object = "answers"  # without a time limit
        acked, cycle = 0, getattr(protocol, "cycle", None)
        if protocol.transport.get_write_buffer_size() > 0:
            info = protocol.transport.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 192)
            state, acked = "writes", struct.unpack_from("Q", info, _BYTES_ACKED)[0]
            if before is not None and acked - before.acked >= _TAKEN_BYTES:
                before = None
        elif hasattr(protocol, "cycle") and (cycle is None or cycle.response_complete):  # sockets of pages have none
            state = ("waits", cycle)
        return before if before is not None and before.state == state else cls(state, now_s, acked)


def _socket_of(protocol: Any) -> Any:
    """Return the socket of a connection; None once it has ended."""
    with suppress(AttributeError):  # asyncio's TLS transport loses its lower transport when it is closed twice
        return protocol.transport.get_extra_info("socket")
    return None


def _shut(connection: socket.socket) -> None:
    """Shut down a connection held by a transport of the loop, which notices it."""
    with suppress(OSError):  # already closed by the client
        connection.shutdown(socket.SHUT_RDWR)


def _network(host: str) -> str:
    """Return the unit that counts as one address: for IPv6 the 64 bits that one customer has at least."""
    address = ip_address(plain_address(host))
    return str(address) if address.version == 4 else f"{ip_address(int(address) >> 64 << 64)}/64"


def plain_address(address: str) -> str:
    """Return the IPv4 address of an IPv4-mapped IPv6 address; others are unchanged."""
    found = ip_address(address.partition("%")[0])
    return str(getattr(found, "ipv4_mapped", None) or found)


def binding_fault(
    address: str, host: str, names: Sequence[str] = (), *, has_tls: bool = False, has_operators: bool = False
) -> str:
    """Return why HTTP must not be served at this address, and the remedy: other machines need TLS and signed-in operators.

    Empty if allowed. address: of --http; host: its host; names: other names of the server, passed on by a proxy.
    """
    is_local = is_loopback_name(host)
    steps = []
    if not is_local and not has_tls:
        steps.append("give it a certificate with --http-cert and --http-key")
    beyond = [name for name in names if not is_loopback_name(name)]
    if (not is_local or beyond) and not has_operators:
        steps.append("add an operator with `mapserver operators add NAME --role admin`")
    if not steps:
        return ""
    where = f"--http {address}" if not is_local else f"--http-name {beyond[0]}"
    return f"{where} can be reached from other machines; {', and '.join(steps)} (or allow everyone with --insecure)"
