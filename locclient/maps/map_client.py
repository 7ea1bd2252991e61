"""A robot's client of the map server: maps through a cache, acknowledgements and reports; and a command's connection to its map."""

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import msgspec

from fleetmap import errors, messages
from fleetmap.bus.endpoints import is_loopback
from fleetmap.bus.zenoh_bus import Bus, Handle
from fleetmap.errors import LinkError, MapFormatError, StoreError, UnreachableError, UsageError, disk_errors
from fleetmap.mapformat.manifest import MAX_MANIFEST_BYTES, Manifest
from fleetmap.mapformat.names import check_name, sha256_hex, verified
from fleetmap.messages import PART_BYTES, FailureAck, Part, RobotAck, WantedVersion, decode_message, encode_message
from fleetmap.trust.trusted_map import TrustedMap, ask_over
from fleetmap.version_grid import grid_blobs
from locclient.identity import MapAddress
from locclient.maps import map_source
from locclient.maps.tile_cache import DEFAULT_MAX_BYTES, TileCache

T = TypeVar("T", bound=msgspec.Struct)
_NOWHERE = "tcp/127.0.0.1:7447"
_PATIENCE_S = 120.0  # without an answer during a fetch; long enough for a server's restart
_RETRY_S = 0.2
_MAX_INCOMPLETE = 8
_log = logging.getLogger(__name__)


@dataclass
class ChunkReader:
    """Reads chunked downloads from a server. Chunks of an incomplete download are kept across errors and calls.

    timeout_s: for each chunk. patience_s: time without any chunk after which a read fails; a later read resumes it. received_bytes: so far.
    """

    bus: Bus
    timeout_s: float
    patience_s: float
    clock_s: Callable[[], float] = time.monotonic
    received_bytes: int = 0
    _incomplete: dict[str, bytearray] = field(default_factory=dict)

    def read(self, key: str, *, max_bytes: int) -> bytes:
        """Return all bytes under `key`, not yet verified.

        Raises UnreachableError without an answer, LinkError for a refusal, for more than max_bytes, for incomplete parts and for
        invalid responses.
        """
        data = self._incomplete.pop(key, bytearray())
        try:
            while (chunk := self._chunk(key, len(data), max_bytes)).total_bytes > len(data) + len(chunk.data):
                data += chunk.data
            return bytes(data + chunk.data)
        except UnreachableError:
            self._incomplete[key] = data
            while len(self._incomplete) > _MAX_INCOMPLETE:
                self._incomplete.pop(next(iter(self._incomplete)))
            raise

    def _chunk(self, key: str, offset: int, max_bytes: int) -> Part:
        chunk = self._request(key, encode_message(messages.ChunkRequest(offset=offset)))
        self.received_bytes += len(chunk.data)
        if chunk.total_bytes > max_bytes:
            raise LinkError(f"{key} has {chunk.total_bytes} bytes where at most {max_bytes} are expected")
        if chunk.offset != offset or offset + len(chunk.data) > chunk.total_bytes:
            raise LinkError(f"{key}: requested from byte {offset} on, got {len(chunk.data)} from {chunk.offset} on")
        # Smaller parts would let a malicious server occupy a robot forever: a full part must arrive within each patience.
        if len(chunk.data) < min(PART_BYTES, chunk.total_bytes - offset):
            raise LinkError(
                f"{key}: {len(chunk.data)} bytes from byte {offset} on of {chunk.total_bytes}, where a part has {PART_BYTES}; "
                "check that both sides run the same fleetmap, and that the map server answers"
            )
        return chunk

    def _request(self, key: str, request: bytes) -> Part:
        """Repeat the request until an answer or the end of patience. Raises UnreachableError, or LinkError for a refusal."""
        deadline_s = self.clock_s() + self.patience_s
        while True:
            try:
                return decode_message(self.bus.get(key, request, timeout_s=self.timeout_s), Part)
            except UnreachableError:
                if self.clock_s() >= deadline_s:
                    raise
                time.sleep(_RETRY_S)


class MapClient(map_source.MapSource):
    """Fetches maps through a cache, and sends reports.

    Cached bytes are not fetched again: a known version can be read while the server is unreachable, and of a new one only the
    changed tiles are fetched. trust: signed list that admits new versions, None for any; the active version stays in any case.
    """

    def __init__(
        self, bus: Bus, cache: TileCache, site: str, robot: str, *, timeout_s: float = 5.0, patience_s: float = 0.0
    ) -> None:
        """patience_s: maximum interruption of a fetch. Raises UsageError for names that cannot be keys."""
        super().__init__(site)
        self.bus, self.cache = bus, cache
        self.robot = check_name(robot, "robot")
        self.chunks = ChunkReader(bus, timeout_s=timeout_s, patience_s=patience_s)
        self.trust: TrustedMap | None = None
        self.takes_grids = False  # for planners, if versions have them; localization does not need them
        self._brought: WantedVersion | None = None  # since the start, with all that this robot takes
        self.surveys: tuple[messages.SurveyArea, ...] = ()  # that robots may make, by its last answer
        self.restored_ns = 0  # when the server's store was restored from a backup, by its last answer
        self._begun = ""  # the manifest's address of the version that was admitted last

    # --- versions -----------------------------------------------------------------------------------------------------

    def wanted(self) -> WantedVersion:
        """Return the version that the server wants this robot to run; LinkError without an answer."""
        wanted = decode_message(self.bus.get(self._key("wanted"), timeout_s=self.chunks.timeout_s), WantedVersion)
        if wanted.site != self.site:
            raise LinkError(f"requested site {self.site}, the server answered for {wanted.site[:80]!r}")
        if self.trust is not None:
            self.trust.refresh()
        self.restored_ns, self.surveys = wanted.restored_ns, wanted.surveys
        return msgspec.structs.replace(wanted, restored_ns=0, surveys=())

    def hear(self, name: str, kind: type[T], listener: Callable[[T], None]) -> Handle:
        """Call `listener`, on a thread of the bus, with every message that the server publishes for this robot: `wanted`, when it wants
        another version, and `initial_pose`, when an operator sets the robot's."""
        return self.bus.subscribe(self._key(name), lambda _, payload: listener(decode_message(payload, kind)))

    def active(self) -> WantedVersion | None:
        """Return the active version, complete in the cache; None before the first one."""
        active = self.cache.active(self.site)
        return None if active is None else active.wanted(self.site)

    def ready(self) -> map_source.ReadyVersion:
        """Return the wanted version, complete and active; else the active one; else the wanted one as far as it can be fetched.

        Raises LinkError without an answer and without an active version.
        """
        active = self.active()
        try:
            wanted = self.wanted()
            if wanted != active:
                self.bring(wanted)
        except (LinkError, MapFormatError, StoreError) as error:
            if active is not None:
                return map_source.ReadyVersion(active, f"version {active.version} stays active: {error}")
            if isinstance(error, UnreachableError):
                raise
            return map_source.ReadyVersion(self.wanted(), str(error))
        return map_source.ReadyVersion(wanted)

    def newest(self, *, asks: bool = True) -> WantedVersion:
        """Return the version that the site's signed list names as current, fetched and active; else the active one.

        The server chooses no version for a robot of another site, so that it tries none there. Errors as of `fetch`, without an active one.
        """
        active = self.active()
        if not asks:
            if active is None:
                raise LinkError(f"the cache has no version of site {self.site} yet")
            return active
        try:
            if self.trust is None:
                raise errors.UntrustedError("signature", "this robot has no signed lists")
            wanted = self.trust.current()
            # An active version may have come before planners needed grids, or without its own.
            if wanted != (self._brought if self.takes_grids else active):
                self.bring(wanted)
        except (LinkError, MapFormatError, StoreError) as error:
            if active is None:
                raise
            _log.info("site %s: version %s stays active: %s", self.site, active.version, error)
            return active
        return wanted

    def bring(self, wanted: WantedVersion) -> None:
        """Fetch all of a version into the cache and activate it; errors as of `fetch` and `activate`."""
        self.activate(self.fetch(wanted), wanted)
        self._brought = wanted

    def fetch(self, wanted: WantedVersion) -> Manifest:
        """Fetch all of a version into the cache, where it is kept until `activate` or the next fetch; return its manifest.

        After an error, received data stay in the cache and the active version does not change. Raises UnreachableError without an
        answer, LinkError for missing and MapFormatError for damaged data, StoreError on a disk error.
        """
        self._begun = ""
        manifest = self.manifest(wanted)
        self.cache.reserve(self.site, map_source.addresses_of(manifest, wanted.manifest_sha256 or ""))
        self.vocabulary(manifest)
        for entry in manifest.tiles:
            # Decode to validate, do not keep: a large site exceeds a robot's memory.
            map_source.checked_tile(entry, manifest.tile_size_m, self.blob(entry.sha256, entry.bytes))
        if self.takes_grids:
            try:
                for sha256, size_bytes in grid_blobs(manifest, self.blob).items():
                    self.blob(sha256, size_bytes)
            except UnreachableError:
                raise
            except (LinkError, MapFormatError) as error:  # planners need the grid, localization does not
                _log.warning("version %s comes without its grid for planners: %s", manifest.version, error)
        return manifest

    def activate(self, manifest: Manifest, wanted: WantedVersion) -> None:
        """Make a fetched version the one that the robot starts with; StoreError if a piece of it is missing."""
        addresses = map_source.addresses_of(manifest, wanted.manifest_sha256 or "")
        with suppress(LinkError, MapFormatError):  # of a grid that is not complete in the cache
            found = grid_blobs(manifest, map_source.CachedMap(self.cache, self.site).blob)
            addresses += found if all(sha256 in self.cache for sha256 in found) else ()
        self.cache.activate(self.site, manifest.version, addresses)

    # --- contents of a version ----------------------------------------------------------------------------------------

    def manifest(self, wanted: WantedVersion) -> Manifest:
        """Return the wanted version's manifest, from the cache or the server.

        Raises LinkError if the site has no version or the server does not answer, UntrustedError if signed lists do not admit it,
        MapFormatError for wrong bytes.
        """
        version, sha256 = map_source.address_of(wanted)
        active = self.cache.active(self.site)
        is_active = active is not None and sha256 == active.blobs[0]
        max_bytes = MAX_MANIFEST_BYTES
        # By the signed list; the manifest defines all else of a version, by hash and size. An admitted fetch is completed even if the
        # list has changed meanwhile.
        if not is_active and self.trust is not None and sha256 != self._begun:
            max_bytes = self.trust.admitted(wanted).length
            self._begun = sha256
        return map_source.checked_manifest(self._blob(self._key(f"manifests/{version}"), sha256, max_bytes), wanted)

    def blob(self, sha256: str, max_bytes: int = 0) -> bytes:
        """Return the verified bytes of an address, from the cache or the server; errors as of `manifest`."""
        return self._blob(self._key(f"blobs/{sha256}"), sha256, max_bytes)

    def _is_at_hand(self, sha256: str) -> bool:
        return sha256 in self.cache

    def _blob(self, key: str, sha256: str, max_bytes: int) -> bytes:
        """Return the verified bytes of an address, from the cache or the server, and cache them."""
        data = self.cache.get(sha256)
        if data is None:
            data = verified(self.chunks.read(key, max_bytes=max_bytes), sha256)
            self.cache.put(sha256, data)
        return data

    # --- what a site keeps beside its versions ------------------------------------------------------------------------

    def site_file(self, kind: str, max_bytes: int) -> bytes | None:
        """Return the file of this kind by the last fresh signed list, or the cached one; None if the site has none.

        Errors as of `manifest`; the cached file stays.
        """
        kept = self.cache.kept_file(self.site, kind)
        named = None if self.trust is None else self.trust.files
        if named is None or (kept is not None and sha256_hex(kept) == named.get(kind)):
            return kept
        data = None
        if (sha256 := named.get(kind)) is not None:
            data = verified(self.chunks.read(self._key(f"blobs/{sha256}"), max_bytes=max_bytes), sha256)
        self.cache.keep_file(self.site, kind, data)
        return data

    # --- reports ------------------------------------------------------------------------------------------------------

    def announce_presence(self) -> Handle:
        """Announce this robot to the server, until the handle or the bus is closed."""
        return self.bus.declare_alive(self._key("alive"))

    def ack(self, version: int | None, *, stamp_ns: int, refused: str = "") -> None:
        """Report to the server the running version and, if it is not the wanted one, the reason."""
        message = RobotAck(site=self.site, robot=self.robot, stamp_ns=stamp_ns, version=version, refused=refused[:2000])
        self.publish("ack", message)

    def deliver(self, name: str, payload: bytes) -> FailureAck:
        """Send an encoded FailureReport to `failures`, or a ReplayPart to `replays`, and return the server's answer, once stored on its
        disk; errors as of `wanted`."""
        return decode_message(self.bus.get(self._key(name), payload, timeout_s=self.chunks.timeout_s), FailureAck)

    def publish(self, name: str, message: msgspec.Struct, *, may_drop: bool = False) -> None:
        """Publish a message of the robot; may_drop: on a congested network, where the next one replaces it."""
        self.bus.publish(self._key(name), encode_message(message), may_drop=may_drop)

    def _key(self, name: str) -> str:
        return messages.robot_key(self.site, self.robot, name)


def open_bus(address: MapAddress) -> Bus:
    """Open a connection to the server, with the robot's identity if it has one. Without a server the bus stays closed."""
    tls = None if address.identity is None else address.identity.tls
    return Bus(_NOWHERE) if address.server is None else Bus(str(address.server), tls=tls).open()


def map_client(bus: Bus, cache: TileCache, address: MapAddress, **how: float) -> MapClient:
    """Return the client of a site's maps, which demands signed lists of a server; it has none if a fleet manager brings the maps.

    how: arguments of `MapClient`. UsageError if a required root is missing or cannot be read.
    """
    site, server, data = address.site, address.server, None
    client = MapClient(bus, cache, site, address.robot, **{"patience_s": _PATIENCE_S} | how)
    if server is None:
        return client
    if address.root is not None:
        with disk_errors(
            f"the root {address.root} cannot be read", "copy 1.root.json of the server's store", UsageError
        ):
            data = Path(address.root).read_bytes()
    elif not is_loopback(server):
        raise UsageError(
            f"{server} needs a root of trust for its maps: copy trust/1.root.json of the server's store to the robot and set root"
        )
    client.trust = TrustedMap(cache.folder / "trust" / site, site, data, ask_over(bus, site, address.robot))
    return client


@contextmanager
def connected(
    address: MapAddress, cache_setting: Path | None = None, cache_bytes: int = DEFAULT_MAX_BYTES
) -> Iterator[map_source.MapSource]:
    """Open the maps of an address, with a cache of at most so many bytes; close them afterwards."""
    if address.store is not None:
        yield map_source.LocalMapSource(Path(address.store), address.site, address.version)
        return
    cache = TileCache(cache_folder(cache_setting), max_bytes=cache_bytes)
    with open_bus(address) as bus:
        yield map_client(bus, cache, address)


def cache_folder(setting: str | Path | None = None) -> Path:
    """Return the folder of the setting `cache`, else `fleetmap/tiles` in the user's cache folder (XDG_CACHE_HOME)."""
    if setting is not None:
        return Path(setting)
    return Path(os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))) / "fleetmap" / "tiles"
