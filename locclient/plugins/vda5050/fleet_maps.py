"""Versions downloaded for a fleet manager over HTTP, from servers that the robot's owner configured. All of them stay on the disk until it
deletes them."""

import hashlib
import http.client
import logging
import socket
import ssl
import tempfile
import threading
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import IO, NamedTuple
from urllib.parse import SplitResult, urlsplit

from fleetmap.bus.endpoints import is_loopback_name
from fleetmap.errors import LinkError, MapFormatError, StateError, StoreError, UnreachableError, UsageError, disk_errors
from fleetmap.mapformat.version_file import ExportReader, open_export
from fleetmap.messages import WantedVersion
from locclient.maps.map_client import MapClient
from locclient.maps.map_source import addresses_of
from locclient.maps.tile_cache import ActiveVersion
from locclient.plugins.vda5050.actions import RefusedActionError

_TOGETHER = 2  # space for a file, and for its extracted blobs
_CHUNK_BYTES = 1 << 18
_STALL_S = 30.0  # without a byte
_MIN_BYTES_PER_S = 20_000  # mean of a file, after _STALL_S: no server may occupy the network thread for a day
_REMEDY = "; delete a map, or raise [run] cache_bytes"
_HALF = f": half of the room in the cache{_REMEDY}"
_no_room = partial(RefusedActionError, "INSUFFICIENT_MEMORY", level="URGENT")
_log = logging.getLogger(__name__)


class Origins(NamedTuple):
    """Allowed servers of files. token: bearer token sent to them; ca: file of authorities, None for the machine's."""

    allowed: Sequence[str]
    token: str | None = None
    ca: Path | None = None
    insecure: bool = False

    def check(self) -> None:
        """Raise UsageError for an invalid origin."""
        for text in self.allowed:
            origin = _origin(text)
            if origin is None or urlsplit(text).path not in {"", "/"}:
                raise UsageError(f"{text!r} is not like https://HOST or https://HOST:PORT")
            if origin[0] == "http" and not (self.insecure or is_loopback_name(origin[1])):
                raise UsageError(f"{text} is on another machine and without TLS; use https, or --insecure")

    def admit(self, link: str) -> SplitResult:
        """Return the parts of a link; LinkError unless it points to one of the servers."""
        origin = _origin(link)
        if origin is None or any(ord(sign) < 33 or ord(sign) > 126 for sign in link):
            raise LinkError(f"the link {link[:200]!r} is not a plain http or https address")
        parts = urlsplit(link)
        if origin not in map(_origin, self.allowed):
            raise LinkError(
                f"the link points to {parts.netloc[:200]!r}, and the robot takes maps from "
                f"{', '.join(self.allowed) or 'nowhere'}; [vda5050] download_from names the servers"
            )
        return parts


def download(link: str, origins: Origins, target: IO[bytes], *, max_bytes: int) -> str:
    """Download a link into `target` and return the SHA-256. Redirections are not followed.

    Raises LinkError for a refused link or a response that is an error, RefusedActionError for one longer than max_bytes, UnreachableError
    if the server does not answer or stalls, StoreError on a disk error.
    """
    parts = origins.admit(link)
    connection = _connection(parts, origins)
    headers = {"User-Agent": "fleetmap", "Accept-Encoding": "identity"}
    if origins.token is not None:
        headers["Authorization"] = f"Bearer {origins.token}"
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    try:
        connection.connect()
        # Each byte of a head, and each `100 Continue`, begins the socket's own time anew; that of a handshake is limited as a whole.
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
        raise _no_room(f"{link[:200]} has {answer.length} bytes, the limit is {max_bytes}{_HALF}")
    while chunk := answer.read1(_CHUNK_BYTES):
        received += len(chunk)
        if received > max_bytes:
            raise _no_room(f"{link[:200]} has more than {max_bytes} bytes{_HALF}")
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


def _origin(link: str) -> tuple[str, str, int] | None:
    """Return scheme, host and port; None for an invalid web address, or one that contains a name and password."""
    try:
        parts = urlsplit(link)
        port = parts.port or (443 if parts.scheme == "https" else 80)
    except ValueError:
        return None
    is_plain = parts.scheme in {"http", "https"} and "@" not in parts.netloc
    return (parts.scheme, parts.hostname, port) if is_plain and parts.hostname else None


class FleetMaps:
    """For the thread that owns the robot's cache. Without a map server it takes what the fleet manager names with its hash."""

    def __init__(self, client: MapClient, origins: Origins) -> None:
        """Raises UsageError for invalid origins. A disk error now makes later downloads fail."""
        origins.check()
        self._client, self._cache, self._site, self._origins = client, client.cache, client.site, origins
        self._folder = client.cache.folder / "incoming"
        active = client.cache.active(client.site)
        try:
            with disk_errors(f"{self._folder} cannot be used", "choose another cache"):
                self._folder.mkdir(parents=True, exist_ok=True)
                for leftover in self._folder.glob("*.fmex"):
                    leftover.unlink()
            if active is not None and active not in self._cache.kept(self._site):
                self._cache.keep(self._site, active.version, active.blobs)
        except StoreError as error:
            _log.warning("maps of the fleet manager cannot be downloaded: %s", error)

    def versions(self) -> list[tuple[int, bool]]:
        """Return the versions on the disk, oldest first, each with True if enabled."""
        return [(kept.version, kept == self._cache.active(self._site)) for kept in self._cache.kept(self._site)]

    def download(self, version: int, link: str, sha256: str | None) -> None:
        """Fetch a version's file, check it by the signed list, and keep the version. Other versions are not affected.

        sha256: of the file, None or empty if unknown.

        Raises RefusedActionError, LinkError, UntrustedError, MapFormatError, StoreError.
        """
        if version in dict(self.versions()):
            words = f"version {version} is on the robot already; delete it before another download"
            raise RefusedActionError("DUPLICATE_MAP", words)
        if self._client.trust is None and not sha256:
            raise LinkError("without a map server no signed list admits a file; send its SHA-256 as mapHash")
        room_bytes = self._cache.room_bytes() // _TOGETHER
        fault = disk_errors(f"{self._folder} cannot be written", "make space for the cache")
        with fault, tempfile.NamedTemporaryFile(dir=self._folder, suffix=".fmex") as file:
            got = download(link, self._origins, file, max_bytes=max(room_bytes, 1))
            file.flush()
            if sha256 and got != sha256.lower():
                raise LinkError(
                    f"the file behind {link[:200]} has SHA-256 {got}, the fleet manager named {sha256[:64]}"
                )
            with open_export(Path(file.name)) as reader:
                self._take(reader, version)

    def _take(self, reader: ExportReader, version: int) -> None:
        head = reader.head
        if (head.site, head.version) != (self._site, version):
            raise MapFormatError(
                f"the file holds version {head.version} of {head.site}, wanted was {version} of {self._site}"
            )
        self._check_admitted(WantedVersion(site=head.site, version=version, manifest_sha256=head.blobs[0].sha256))
        manifest = reader.manifest()
        reader.check_tiles(manifest)
        new = [blob for blob in head.blobs if blob.kind != "archive" and blob.sha256 not in self._cache]
        if sum(blob.bytes for blob in new) > self._cache.room_bytes():
            raise _no_room(f"version {version} does not fit into the cache{_REMEDY}")
        for number, blob in enumerate(head.blobs):
            if blob in new:
                self._cache.put(blob.sha256, reader.data(number))
        self._cache.keep(self._site, version, addresses_of(manifest, head.blobs[0].sha256))

    def wanted(self, version: int) -> WantedVersion:
        """Return a version for use now; StateError if it is not on the disk, UntrustedError if it was withdrawn."""
        wanted = self._get(version).wanted(self._site)
        self._check_admitted(wanted)
        return wanted

    def _check_admitted(self, wanted: WantedVersion) -> None:
        """Fetch the signed lists of a map server, and raise UntrustedError or UnreachableError unless they admit this version now."""
        if self._client.trust is not None:
            self._client.trust.refresh()
            self._client.trust.admitted(wanted)

    def delete(self, version: int, in_use: set[int]) -> None:
        """Remove a version; StateError if it is enabled, in use or absent."""
        record = self._get(version)
        if version in in_use or record == self._cache.active(self._site):
            raise StateError(f"version {version} is in use; enable another one first")
        self._cache.release(self._site, version)

    def _get(self, version: int) -> ActiveVersion:
        records = {record.version: record for record in self._cache.kept(self._site)}
        if version not in records:
            known = ", ".join(map(str, records)) or "none"
            raise StateError(f"version {version} is not on the robot, which has {known}")
        return records[version]
