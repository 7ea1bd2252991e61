"""What strangers may hold open of the HTTP server: connections of one address and of all, and for how long."""

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
from typing import Any, NoReturn

from fleetmap.log_lines import LogLimit

MAX_CONNECTIONS, MAX_OF_ADDRESS = 512, 64
MAX_HEAD_BYTES = 16 << 10
HEAD_S = 10.0  # until a request's head is there, also behind the request before; and for the handshake of TLS
BACKLOG = 256
_LOOK_EVERY_S = 1.0
_TAKEN_S, _TAKEN_BYTES = 30.0, 150_000  # a client that takes less of what waits for it holds the server's memory
_BYTES_ACKED = 120  # place of tcpi_bytes_acked in Linux's struct tcp_info
_PROXY = "a proxy"
_log = logging.getLogger(__name__)


def raise_file_limit() -> None:
    """Lets this process open as many files as its hard limit allows: the usual soft one, 1024, is less than robots and strangers need."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


class BoundedListener(socket.socket):
    """A listening socket that closes connections above the limits at once.

    asyncio's own loop calls `accept` of this object; uvloop does not. Connections count from here on, before any handshake of TLS.
    """

    def __init__(self, family: int, proxies: frozenset[str] = frozenset()) -> None:
        """proxies: addresses of proxies, which bring everybody's requests and have no limit of their own."""
        super().__init__(family, socket.SOCK_STREAM)
        self._proxies = proxies
        self._open: list[tuple[socket.socket, str, float]] = []  # with the address and when it was accepted
        self._refusals = LogLimit(_log)

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; ConnectionAbortedError for one above the limits, which is closed.

        Where all are taken, the oldest one of the address that has the most makes room for one of an address that has fewer.
        """
        connection, address = super().accept()
        host = _network(address[0])
        if plain_address(address[0]) in self._proxies:
            host = _PROXY
        self._open = [entry for entry in self._open if entry[0].fileno() >= 0]
        counts = Counter(other for _, other, _ in self._open if other != _PROXY)
        busiest, most = max(counts.items(), key=itemgetter(1), default=("", 0))
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        if counts[host] >= MAX_OF_ADDRESS:
            self._refuse(connection, f"{host} has {MAX_OF_ADDRESS} connections open")
        # Numbers of files are given from below: the last quarter is for the store and the bus.
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
        """Ends connections that make no progress, for ever. protocols: uvicorn's, of those whose handshake is done."""
        marks: dict[Any, _Mark] = {}
        while True:
            await asyncio.sleep(_LOOK_EVERY_S)
            try:
                marks = self._look(marks, protocols)
            except Exception:
                _log.exception("looking for connections without progress failed")

    def _look(self, marks: "dict[Any, _Mark]", protocols: set[Any]) -> "dict[Any, _Mark]":
        now_s = time.monotonic()
        protocols = {protocol for protocol in protocols if _socket_of(protocol) is not None}
        marks = {protocol: _Mark.after(marks.get(protocol), protocol, now_s) for protocol in protocols}
        for protocol, mark in marks.items():
            if mark.is_late(now_s):
                protocol.transport.abort()
        known = {held.fileno() for protocol in protocols if (held := _socket_of(protocol)) is not None}
        for connection, _, since_s in self._open:  # the handshake of the others is not done
            if connection.fileno() not in known and now_s - since_s > HEAD_S:
                _shut(connection)
        return marks


class _Mark:
    """Since when a connection is as it is. acked: bytes that the client had taken then."""

    def __init__(self, state: object, since_s: float, acked: int) -> None:
        self.state, self.since_s, self.acked = state, since_s, acked

    @classmethod
    def after(cls, before: "_Mark | None", protocol: Any, now_s: float) -> "_Mark":
        state: object = "answers"  # which may take its time
        acked, cycle = 0, getattr(protocol, "cycle", None)
        if protocol.transport.get_write_buffer_size() > 0:
            info = protocol.transport.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 192)
            state, acked = "writes", struct.unpack_from("Q", info, _BYTES_ACKED)[0]
            if before is not None and acked - before.acked >= _TAKEN_BYTES:
                before = None
        elif hasattr(protocol, "cycle") and (cycle is None or cycle.response_complete):  # sockets of pages have none
            state = ("waits", cycle)
        return before if before is not None and before.state == state else cls(state, now_s, acked)

    def is_late(self, now_s: float) -> bool:
        return self.state != "answers" and now_s - self.since_s > (_TAKEN_S if self.state == "writes" else HEAD_S)


def _socket_of(protocol: Any) -> Any:
    """The socket of a connection; None once it has ended."""
    with suppress(AttributeError):  # asyncio's TLS transport loses what lies below it when it is closed twice
        return protocol.transport.get_extra_info("socket")
    return None


def _shut(connection: socket.socket) -> None:
    """Ends a connection that a transport of the loop holds, which notices."""
    with suppress(OSError):  # the client was faster
        connection.shutdown(socket.SHUT_RDWR)


def _network(host: str) -> str:
    """What counts as one address: of IPv6 the 64 bits that one customer of a network has at least."""
    address = ip_address(host.partition("%")[0])
    if address.version == 4:
        return str(address)
    return str(address.ipv4_mapped or f"{ip_address(int(address) >> 64 << 64)}/64")


def plain_address(address: str) -> str:
    """Of IPv4 addresses in IPv6 the former, as sockets of both kinds write them."""
    found = ip_address(address.partition("%")[0])
    return str(getattr(found, "ipv4_mapped", None) or found)


def binding_fault(
    address: str, host: str, names: Sequence[str] = (), *, has_tls: bool = False, has_operators: bool = False
) -> str:
    """Why HTTP must not be served like this, and what to do: on this machine to everybody, beyond it with TLS to operators alone.

    Empty where it may. address: of --http; host: its host; names: others that the server goes by, as a proxy passes them on.
    """
    is_local = is_loopback_name(host)
    steps = []
    if not is_local and not has_tls:
        steps.append("give it a certificate with --http-cert and --http-key")
    beyond = [name for name in names if not is_loopback_name(name)]
    if (not is_local or beyond) and not has_operators:
        steps.append("name who may sign in with `mapserver operators add NAME --role admin`")
    if not steps:
        return ""
    where = f"--http {address}" if not is_local else f"--http-name {beyond[0]}"
    return f"{where} is reached from other machines; {', and '.join(steps)} (or let everybody in with --insecure)"


def is_loopback_name(host: str) -> bool:
    """Whether a host's name or address is the machine itself."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False
