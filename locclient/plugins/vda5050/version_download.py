"""Download of a version's file over HTTP, from servers that the robot's owner configured. The caller verifies its content."""

import hashlib
import http.client
import socket
import ssl
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.parse import SplitResult, urlsplit

from fleetmap.bus import is_loopback
from fleetmap.errors import LinkError, UnreachableError, UsageError, disk_errors

_CHUNK_BYTES = 1 << 18
_STALL_S = 30.0  # without a byte
_MIN_BYTES_PER_S = 20_000  # mean of a file, after _STALL_S: no server may occupy the network thread for a day


class TooLargeError(LinkError):
    """A file that is larger than the free space."""


@dataclass(frozen=True)
class Origins:
    """Allowed servers of files. token: bearer token sent to them; ca: file of authorities, None for the machine's."""

    allowed: Sequence[str]
    token: str | None = None
    ca: Path | None = None
    insecure: bool = False

    def check(self) -> None:
        """Raise UsageError for an invalid origin."""
        for text in self.allowed:
            origin = _origin(urlsplit(text))
            if origin is None or urlsplit(text).path not in {"", "/"}:
                raise UsageError(f"{text!r} is not like https://HOST or https://HOST:PORT")
            if origin[0] == "http" and not (self.insecure or is_loopback(f"tcp/{origin[1]}:{origin[2]}")):
                raise UsageError(f"{text} is on another machine and without TLS; use https, or --insecure")

    def admit(self, link: str) -> SplitResult:
        """Return the parts of a link; LinkError unless it points to one of the servers."""
        try:
            parts = urlsplit(link)
            origin = _origin(parts)
        except ValueError:
            origin = None
        if origin is None or any(ord(sign) < 33 or ord(sign) > 126 for sign in link):
            raise LinkError(f"the link {link[:200]!r} is not a plain http or https address")
        if origin not in {_origin(urlsplit(text)) for text in self.allowed}:
            raise LinkError(
                f"the link points to {parts.netloc[:200]!r}, and the robot takes maps from "
                f"{', '.join(self.allowed) or 'nowhere'}; [vda5050] download_from names the servers"
            )
        return parts


def download(link: str, origins: Origins, target: IO[bytes], *, max_bytes: int) -> str:
    """Download a link into `target` and return the SHA-256. Redirections are not followed.

    Raises LinkError for a refused link or a response that is an error or longer than max_bytes, UnreachableError if the server does not
    answer or stalls, StoreError on a disk error.
    """
    parts = origins.admit(link)
    connection = _connection(parts, origins)
    headers = {"User-Agent": "fleetmap", "Accept-Encoding": "identity"}
    if origins.token is not None:
        headers["Authorization"] = f"Bearer {origins.token}"
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    try:
        connection.connect()
        # Each byte of a head, and each `100 Continue`, begins the socket's own time anew.
        late = threading.Timer(_STALL_S, connection.sock.shutdown, (socket.SHUT_RDWR,))
        late.start()
        try:
            connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
        finally:
            late.cancel()
        if answer.status != http.client.OK:
            raise LinkError(f"{link[:200]} answers {answer.status} {answer.reason[:80]}")
        return _receive(answer, link, target, max_bytes)
    except (OSError, http.client.HTTPException) as error:
        raise UnreachableError(f"{link[:200]} cannot be fetched ({error or type(error).__name__})") from error
    finally:
        connection.close()


def _receive(answer: http.client.HTTPResponse, link: str, target: IO[bytes], max_bytes: int) -> str:
    whole, received, begun_s = hashlib.sha256(), 0, time.monotonic()
    if answer.length is not None and answer.length > max_bytes:
        raise TooLargeError(f"{link[:200]} has {answer.length} bytes, the limit is {max_bytes}")
    while chunk := answer.read1(_CHUNK_BYTES):
        received += len(chunk)
        if received > max_bytes:
            raise TooLargeError(f"{link[:200]} has more than {max_bytes} bytes")
        late_s = time.monotonic() - begun_s - _STALL_S
        if late_s > 0 and received < late_s * _MIN_BYTES_PER_S:
            raise UnreachableError(f"{link[:200]} comes too slowly: {received} bytes in {late_s + _STALL_S:.0f} s")
        whole.update(chunk)
        with disk_errors("the downloaded map cannot be written", "make space for the cache"):
            target.write(chunk)
    if answer.length:
        raise UnreachableError(f"{link[:200]} ended {answer.length} bytes early")
    return whole.hexdigest()


def _connection(parts: SplitResult, origins: Origins) -> http.client.HTTPConnection:
    host, port = str(parts.hostname), parts.port
    if parts.scheme == "http":
        return http.client.HTTPConnection(host, port, timeout=_STALL_S)
    with disk_errors(f"the authorities in {origins.ca} cannot be read", "check [vda5050] ca", UsageError):
        context = ssl.create_default_context(cafile=None if origins.ca is None else str(origins.ca))
    return http.client.HTTPSConnection(host, port, timeout=_STALL_S, context=context)


def _origin(parts: SplitResult) -> tuple[str, str, int] | None:
    """Return scheme, host and port; None for an invalid web address, or one that contains a name and password."""
    try:
        port = parts.port or (443 if parts.scheme == "https" else 80)
    except ValueError:
        return None
    is_plain = parts.scheme in {"http", "https"} and "@" not in parts.netloc
    return (parts.scheme, parts.hostname, port) if is_plain and parts.hostname else None
