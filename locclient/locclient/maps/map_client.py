"""How a robot gets its map and reports: over the bus from a server, or out of a store's folder."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Protocol

from fleetmap.bow.shipped_vocabulary import shipped_vocabulary
from fleetmap.bus import Bus, Handle
from fleetmap.errors import FleetmapError, LinkError, MapFormatError, StoreError, UnreachableError
from fleetmap.mapformat import (
    MAX_MANIFEST_BYTES,
    Manifest,
    Tile,
    TileEntry,
    apply_patch,
    check_name,
    check_sha256,
    decode_manifest,
    decode_tile,
    verified,
)
from fleetmap.messages import (
    EstimateMessage,
    FailureAck,
    PoseMessage,
    RobotAck,
    RobotHealth,
    WantedVersion,
    blob_key,
    decode_message,
    encode_message,
    manifest_key,
    patch_key,
    robot_key,
)
from locclient.maps.chunked_download import ChunkReader
from locclient.maps.tile_cache import ActiveVersion, StoreFolder, TileCache


@dataclass(frozen=True)
class FetchedTiles:
    """Tiles that are whole, and for each other one why the robot goes on without it."""

    tiles: dict[tuple[int, int], Tile] = field(default_factory=dict)
    refused: dict[tuple[int, int], str] = field(default_factory=dict)


@dataclass(frozen=True)
class ReadyVersion:
    """The version to run now; note: why it is not the one that is wanted or not whole, empty where it is."""

    wanted: WantedVersion
    note: str = ""


class MapSource(Protocol):
    """What a robot reads its map from."""

    def ready(self) -> ReadyVersion:
        """The version to run now."""

    def manifest(self, wanted: WantedVersion) -> Manifest:
        """The manifest of that version."""

    def vocabulary(self, manifest: Manifest) -> bytes:
        """The vocabulary of that version."""

    def tiles(self, manifest: Manifest, cells: Iterable[tuple[int, int]] | None = None) -> FetchedTiles:
        """Tiles of that version: all, or those of `cells` that it has."""


class MapClient:
    """A robot's link to the server, through a cache.

    Bytes that are in the cache are not asked for again, so a known version can be read with the server away. Of what a robot
    has in its active version it asks for patches; where there is none, or it does not fit, for the whole.
    """

    def __init__(
        self, bus: Bus, cache: TileCache, site: str, robot: str, *, timeout_s: float = 5.0, patience_s: float = 0.0
    ) -> None:
        """patience_s: how long a server may be away in the middle of a fetch. Raises UsageError for names that cannot be keys."""
        self._bus = bus
        self._cache = cache
        self._site = check_name(site, "site")
        self._robot = check_name(robot, "robot")
        self._timeout_s = timeout_s
        self._parts = ChunkReader(bus, timeout_s=timeout_s, patience_s=patience_s)

    @property
    def received_bytes(self) -> int:
        """Bytes of maps that came over the bus so far."""
        return self._parts.received_bytes

    def announce_presence(self) -> Handle:
        """Shows the server that this robot is there, until the handle or the bus is closed."""
        return self._bus.declare_alive(self._key("alive"))

    def wanted(self) -> WantedVersion:
        """The version that the server wants this robot to run; raises LinkError when nobody answers."""
        wanted = decode_message(self._bus.get(self._key("wanted"), timeout_s=self._timeout_s), WantedVersion)
        if wanted.site != self._site:
            raise LinkError(f"asked for site {self._site}, the server answered for {wanted.site[:80]!r}")
        return wanted

    def on_wanted(self, listen: Callable[[WantedVersion], None]) -> Handle:
        """Calls `listen`, on a thread of the bus, whenever the server wants another version."""
        return self._bus.subscribe(
            self._key("wanted"), lambda _, payload: listen(decode_message(payload, WantedVersion))
        )

    def ready(self) -> ReadyVersion:
        """The wanted version, whole and active; without it the active one; without that the wanted one as far as it comes.

        Raises LinkError where nobody answers and no version is active.
        """
        active = self._cache.active(self._site)
        kept = None if active is None else _wanted_of(self._site, active)
        try:
            wanted = self.wanted()
            if wanted != kept:
                self.bring(wanted)
        except (LinkError, MapFormatError, StoreError) as error:
            if kept is not None:
                return ReadyVersion(kept, f"version {kept.version} goes on: {error}")
            if isinstance(error, UnreachableError):
                raise
            return ReadyVersion(self.wanted(), str(error))
        return ReadyVersion(wanted)

    def bring(self, wanted: WantedVersion) -> None:
        """Fetches all of a version into the cache and makes it the active one; errors as of `fetch` and `activate`."""
        self.activate(self.fetch(wanted), wanted)

    def fetch(self, wanted: WantedVersion) -> Manifest:
        """Fetches all of a version into the cache, where it is kept until `activate` or the next fetch; returns its manifest.

        What came before an error stays in the cache, and the active version what it was. Raises UnreachableError where nobody
        answers, LinkError and MapFormatError for what cannot be had or is damaged, StoreError where the disk refuses.
        """
        manifest = self.manifest(wanted)
        self._cache.hold(self._site, _addresses(manifest, wanted))
        self.vocabulary(manifest)
        bases = self._bases()
        for entry in manifest.tiles:
            # Decoded and let go: a large site is larger than a robot's memory.
            _tile(entry, manifest.tile_size_m, self._blob(entry.sha256, entry.bytes, bases.get((entry.x, entry.y))))
        return manifest

    def activate(self, manifest: Manifest, wanted: WantedVersion) -> None:
        """Makes a fetched version the one that the robot starts with; raises StoreError where a piece of it is missing."""
        self._cache.activate(self._site, manifest.version, _addresses(manifest, wanted))

    def active(self) -> WantedVersion | None:
        """The version that is whole in the cache, None before the first one."""
        active = self._cache.active(self._site)
        return None if active is None else _wanted_of(self._site, active)

    def tell_failure(self, payload: bytes) -> FailureAck:
        """The server's answer to an encoded FailureReport, once it is on its disk; errors as of `wanted`."""
        return decode_message(self._bus.get(self._key("failures"), payload, timeout_s=self._timeout_s), FailureAck)

    def publish_estimate(self, message: EstimateMessage) -> None:
        """Sends what the robot's own programs navigate by; it may be lost, because the next one is worth more."""
        self._bus.publish(self._key("estimate"), encode_message(message), may_drop=True)

    def connected(self) -> bool:
        """Whether anybody can be reached now."""
        return self._bus.connected()

    def manifest(self, wanted: WantedVersion) -> Manifest:
        """The wanted version's manifest, from the cache or the server.

        Raises LinkError where the site has no version or nobody answers, MapFormatError for bytes that are not the
        wanted ones.
        """
        version, sha256 = _address(wanted)
        data = self._cache.get(sha256)
        if data is None:
            active = self._cache.active(self._site)
            base = None if active is None else active.blobs[0]
            data = self._fetched(manifest_key(self._site, version), sha256, MAX_MANIFEST_BYTES, base)
        return _checked(decode_manifest(data), wanted)

    def vocabulary(self, manifest: Manifest) -> bytes:
        """The version's vocabulary: the one that ships, or from the cache or the server; errors as of `manifest`."""
        entry = manifest.vocabulary
        return shipped_vocabulary(entry.sha256) or self._blob(entry.sha256, entry.bytes, None)

    def tiles(self, manifest: Manifest, cells: Iterable[tuple[int, int]] | None = None) -> FetchedTiles:
        """Tiles of the version, from the cache or the server: all, or those of `cells` that it has.

        Never raises for a tile: one that is damaged or does not come is refused with its reason, the rest stays usable.
        Once nobody answers, only the cache is asked, so that a robot without a network does not wait for every tile.
        """
        silence: list[UnreachableError] = []
        bases = self._bases()

        def blob(entry: TileEntry) -> bytes:
            if silence and entry.sha256 not in self._cache:
                raise silence[0]
            try:
                return self._blob(entry.sha256, entry.bytes, bases.get((entry.x, entry.y)))
            except UnreachableError as error:
                silence.append(error)
                raise

        return _collect(manifest, cells, blob)

    def ack(self, version: int | None, *, stamp_ns: int, refused: str = "") -> None:
        """Tells the server which version this robot runs and, if so, why not the wanted one."""
        message = RobotAck(
            site=self._site, robot=self._robot, stamp_ns=stamp_ns, version=version, refused=refused[:2000]
        )
        self._bus.publish(self._key("ack"), encode_message(message))

    def publish_health(self, health: RobotHealth) -> None:
        """Sends the robot's report."""
        self._bus.publish(self._key("health"), encode_message(health))

    def publish_pose(self, message: PoseMessage) -> None:
        """Sends an estimate; it may be lost when the network is full, because the next one is worth more."""
        self._bus.publish(self._key("pose"), encode_message(message), may_drop=True)

    def _key(self, what: str) -> str:
        return robot_key(self._site, self._robot, what)

    def _bases(self) -> dict[tuple[int, int], str]:
        """The tiles of the active version, which others can be patched from; empty where its manifest is not to be had."""
        active = self._cache.active(self._site)
        data = None if active is None else self._cache.get(active.blobs[0])
        try:
            return {} if data is None else {(tile.x, tile.y): tile.sha256 for tile in decode_manifest(data).tiles}
        except MapFormatError:
            return {}

    def _blob(self, sha256: str, size: int, base: str | None) -> bytes:
        data = self._cache.get(sha256)
        return data if data is not None else self._fetched(blob_key(self._site, sha256), sha256, size, base)

    def _fetched(self, key: str, sha256: str, max_bytes: int, base: str | None) -> bytes:
        """The verified bytes of an address, patched where that works; kept in the cache."""
        data = None if base is None or base == sha256 else self._patched(base, sha256, max_bytes)
        if data is None:
            data = verified(self._parts.read(key, max_bytes=max_bytes), sha256)
        self._cache.put(sha256, data)
        return data

    def _patched(self, base: str, sha256: str, max_bytes: int) -> bytes | None:
        """The same by way of a patch; None where there is none, or it does not lead there."""
        old = self._cache.get(base)
        if old is None:
            return None
        try:
            patch = self._parts.read(patch_key(self._site, base, sha256), max_bytes=max_bytes)
            return verified(apply_patch(old, patch), sha256)
        except UnreachableError:
            raise
        except (LinkError, MapFormatError):
            return None


class CachedMap:
    """The same reading out of the cache alone, without waiting for anybody; for another thread than that of the MapClient.

    Give it a TileCache of its own: it only reads, so that the two do not disturb each other.
    """

    def __init__(self, cache: TileCache, site: str) -> None:
        """Raises UsageError for a name that no site can have."""
        self._cache = cache
        self._site = check_name(site, "site")

    def ready(self) -> ReadyVersion:
        """The active version; raises LinkError before the first one."""
        active = self._cache.active(self._site)
        if active is None:
            raise LinkError(f"the cache has no version of site {self._site} yet; it has to come from a server first")
        return ReadyVersion(_wanted_of(self._site, active))

    def manifest(self, wanted: WantedVersion) -> Manifest:
        """The wanted version's manifest; LinkError where it is not here, MapFormatError where it is another."""
        return _checked(decode_manifest(self._blob(_address(wanted)[1])), wanted)

    def vocabulary(self, manifest: Manifest) -> bytes:
        """The version's vocabulary; LinkError where it is not here."""
        sha256 = manifest.vocabulary.sha256
        return shipped_vocabulary(sha256) or self._blob(sha256)

    def tiles(self, manifest: Manifest, cells: Iterable[tuple[int, int]] | None = None) -> FetchedTiles:
        """Tiles of the version, as `MapClient.tiles`."""
        return _collect(manifest, cells, lambda entry: self._blob(entry.sha256))

    def _blob(self, sha256: str) -> bytes:
        data = self._cache.get(sha256)
        if data is None:
            raise LinkError(f"{sha256} is not in the cache; it has to be fetched again")
        return data


class LocalMapSource:
    """The same reading out of a store's folder, for a robot without a server."""

    def __init__(self, folder: StoreFolder, site: str) -> None:
        """Raises UsageError for a name that no site can have."""
        self._folder = folder
        self._site = check_name(site, "site")

    def ready(self) -> ReadyVersion:
        """The site's current version."""
        return ReadyVersion(self.wanted())

    def wanted(self) -> WantedVersion:
        """The site's current version."""
        sha256 = self._folder.current_manifest(self._site)
        if sha256 is None:
            return WantedVersion(site=self._site, version=None, manifest_sha256=None)
        version = decode_manifest(self._folder.blob(sha256)).version
        return WantedVersion(site=self._site, version=version, manifest_sha256=sha256)

    def manifest(self, wanted: WantedVersion) -> Manifest:
        """The wanted version's manifest; errors as of `MapClient.manifest`, StoreError where bytes are missing."""
        return _checked(decode_manifest(self._folder.blob(_address(wanted)[1])), wanted)

    def vocabulary(self, manifest: Manifest) -> bytes:
        """The version's vocabulary."""
        return self._folder.blob(manifest.vocabulary.sha256)

    def tiles(self, manifest: Manifest, cells: Iterable[tuple[int, int]] | None = None) -> FetchedTiles:
        """Tiles of the version, as `MapClient.tiles`."""
        return _collect(manifest, cells, lambda entry: self._folder.blob(entry.sha256))


def _wanted_of(site: str, active: ActiveVersion) -> WantedVersion:
    return WantedVersion(site=site, version=active.version, manifest_sha256=active.blobs[0])


def _addresses(manifest: Manifest, wanted: WantedVersion) -> list[str]:
    """Of all that a version consists of, its manifest first."""
    vocabulary = manifest.vocabulary.sha256
    words = [] if shipped_vocabulary(vocabulary) else [vocabulary]  # what ships with the program is always here
    return [wanted.manifest_sha256 or "", *words, *(tile.sha256 for tile in manifest.tiles)]


def _address(wanted: WantedVersion) -> tuple[int, str]:
    if wanted.version is None or wanted.manifest_sha256 is None:
        raise LinkError(f"site {wanted.site} has no published version; publish one with `mapserver publish`")
    return wanted.version, check_sha256(wanted.manifest_sha256)


def _checked(manifest: Manifest, wanted: WantedVersion) -> Manifest:
    if (manifest.site, manifest.version) != (wanted.site, wanted.version):
        raise MapFormatError(
            f"the manifest is of {manifest.site} version {manifest.version}, wanted was {wanted.site} {wanted.version}"
        )
    return manifest


def _collect(
    manifest: Manifest, cells: Iterable[tuple[int, int]] | None, blob: Callable[[TileEntry], bytes]
) -> FetchedTiles:
    fetched = FetchedTiles()
    asked = None if cells is None else set(cells)
    for entry in manifest.tiles:
        cell = (entry.x, entry.y)
        if asked is None or cell in asked:
            try:
                fetched.tiles[cell] = _tile(entry, manifest.tile_size_m, blob(entry))
            except FleetmapError as error:
                # The reason is the result: one bad tile must not cost a robot the rest of its map.
                fetched.refused[cell] = str(error)
    return fetched


def _tile(entry: TileEntry, size_m: float, data: bytes) -> Tile:
    tile = decode_tile(data)
    if (tile.tile_x, tile.tile_y, tile.size_m, len(tile)) != (entry.x, entry.y, size_m, entry.landmarks):
        raise MapFormatError(
            f"{tile.name} with {len(tile)} landmarks is not the manifest's ({entry.x}, {entry.y}) of {entry.landmarks}"
        )
    return tile
