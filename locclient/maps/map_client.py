"""A robot's client of the map server: maps through a cache, acknowledgements and reports."""

import logging
import time
from collections.abc import Callable, Iterable
from contextlib import suppress

from fleetmap.bow.shipped_vocabulary import shipped_vocabulary
from fleetmap.bus import Bus, Handle
from fleetmap.errors import LinkError, MapFormatError, StoreError, UnreachableError, UntrustedError
from fleetmap.failure_summary import ReplayPart
from fleetmap.mapformat import (
    MAX_MANIFEST_BYTES,
    Manifest,
    TileEntry,
    check_name,
    sha256_hex,
    verified,
)
from fleetmap.mapformat.building import ALIGNMENT, BuildingFrame, aligned_frame
from fleetmap.messages import (
    PART_BYTES,
    ChunkRequest,
    FailureAck,
    InitialPoseMessage,
    Part,
    PoseMessage,
    RobotAck,
    RobotHealth,
    WantedVersion,
    decode_message,
    encode_message,
    robot_key,
)
from fleetmap.trust import TrustedMap
from fleetmap.version_grid import grid_blobs, grid_index
from locclient.maps.map_source import (
    FetchedTiles,
    MapSource,
    ReadyVersion,
    address_of,
    checked_manifest,
    checked_tile,
)
from locclient.maps.tile_cache import TileCache

_RETRY_S = 0.2
_MAX_INCOMPLETE = 8


class ChunkReader:
    """Reads what a server sends in chunks. Chunks of an incomplete download are kept over errors and calls."""

    def __init__(
        self,
        bus: Bus,
        *,
        timeout_s: float,
        patience_s: float,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """timeout_s: for each chunk. patience_s: without any chunk, after which a read gives up; a later one resumes it."""
        self._bus = bus
        self._timeout_s = timeout_s
        self._patience_s = patience_s
        self._clock_s = clock_s
        self._incomplete: dict[str, bytearray] = {}
        self.received_bytes = 0

    def read(self, key: str, *, max_bytes: int) -> bytes:
        """All bytes under `key`, not yet verified.

        Raises UnreachableError where nobody answers, LinkError for a refusal, for more than max_bytes, for parts that are not full
        and for nonsense.
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
        chunk = self._request(key, encode_message(ChunkRequest(offset=offset)))
        self.received_bytes += len(chunk.data)
        if chunk.total_bytes > max_bytes:
            raise LinkError(f"{key} has {chunk.total_bytes} bytes where at most {max_bytes} are expected")
        if chunk.offset != offset or offset + len(chunk.data) > chunk.total_bytes:
            raise LinkError(f"{key}: asked from byte {offset} on, got {len(chunk.data)} from {chunk.offset} on")
        # Fewer bytes at a time would let whoever answers keep a robot busy for ever: so a part must come within each patience.
        if len(chunk.data) < min(PART_BYTES, chunk.total_bytes - offset):
            raise LinkError(
                f"{key}: {len(chunk.data)} bytes from byte {offset} on of {chunk.total_bytes}, where a part has {PART_BYTES}; "
                "do both sides run the same fleetmap, and is it the server that answers?"
            )
        return chunk

    def _request(self, key: str, request: bytes) -> Part:
        """Repeats the request until it is answered or patience ends. Raises UnreachableError, or LinkError for a refusal."""
        deadline_s = self._clock_s() + self._patience_s
        while True:
            try:
                return decode_message(self._bus.get(key, request, timeout_s=self._timeout_s), Part)
            except UnreachableError:
                if self._clock_s() >= deadline_s:
                    raise
                time.sleep(_RETRY_S)


_MAX_ALIGNMENT_BYTES = 1 << 20
_log = logging.getLogger(__name__)


class MapClient(MapSource):
    """Fetches maps through a cache, and reports.

    Cached bytes are not fetched again: a known version can be read while the server is away, and of a new one only the
    tiles that changed are fetched.
    """

    def __init__(
        self, bus: Bus, cache: TileCache, site: str, robot: str, *, timeout_s: float = 5.0, patience_s: float = 0.0
    ) -> None:
        """patience_s: how long a server may be away in the middle of a fetch. Raises UsageError for names that cannot be keys."""
        super().__init__(site)
        self._bus, self._cache = bus, cache
        self._robot = check_name(robot, "robot")
        self._timeout_s = timeout_s
        self._chunks = ChunkReader(bus, timeout_s=timeout_s, patience_s=patience_s)
        self._trust: TrustedMap | None = None
        self.takes_grids = False  # of planners, where versions have them; a robot localizes without
        self._away: UnreachableError | None = None  # while tiles are read
        self._begun = ""  # the manifest's address of the version that was admitted last

    def require(self, trust: TrustedMap | None) -> None:
        """From now on takes only new versions that the site's signed list admits; None: any. What is active goes on in any case."""
        self._trust = trust

    def check_admitted(self, wanted: WantedVersion) -> None:
        """Asks for the signed lists, and raises UntrustedError or UnreachableError unless they admit this version now."""
        if self._trust is None:
            raise UntrustedError("signature", "this robot believes no signed lists; it needs a server, not a folder")
        self._trust.refresh()
        self._trust.admitted(wanted)

    @property
    def word_hours(self) -> float | None:
        """Hours since the server last proved what may be run; None if it never did, or need not."""
        return None if self._trust is None else self._trust.word_hours

    @property
    def received_bytes(self) -> int:
        """Bytes of maps that came over the bus so far."""
        return self._chunks.received_bytes

    def connected(self) -> bool:
        """Whether anybody can be reached now."""
        return self._bus.connected()

    # --- versions -----------------------------------------------------------------------------------------------------

    def wanted(self) -> WantedVersion:
        """The version that the server wants this robot to run; raises LinkError when nobody answers."""
        wanted = decode_message(self._bus.get(self._key("wanted"), timeout_s=self._timeout_s), WantedVersion)
        if wanted.site != self._site:
            raise LinkError(f"asked for site {self._site}, the server answered for {wanted.site[:80]!r}")
        if self._trust is not None:
            self._trust.refresh()
        return wanted

    def on_wanted(self, listener: Callable[[WantedVersion], None]) -> Handle:
        """Calls `listener`, on a thread of the bus, whenever the server wants another version."""
        key = self._key("wanted")
        return self._bus.subscribe(key, lambda _, payload: listener(decode_message(payload, WantedVersion)))

    def on_initial_pose(self, listener: Callable[[InitialPoseMessage], None]) -> Handle:
        """Calls `listener`, on a thread of the bus, whenever a person says at the server where this robot stands."""

        def hear(_: str, payload: bytes) -> None:
            told = decode_message(payload, InitialPoseMessage)
            if (told.site, told.robot) != (self._site, self._robot):
                raise LinkError(
                    f"a place for robot {told.robot!r} of {told.site!r} came to {self._robot} of {self._site}"
                )
            listener(told)

        return self._bus.subscribe(self._key("initial_pose"), hear)

    def active(self) -> WantedVersion | None:
        """The version that is whole in the cache, None before the first one."""
        active = self._cache.active(self._site)
        return None if active is None else active.wanted(self._site)

    def ready(self) -> ReadyVersion:
        """The wanted version, whole and active; without it the active one; without that the wanted one as far as it comes.

        Raises LinkError where nobody answers and no version is active.
        """
        active = self.active()
        try:
            wanted = self.wanted()
            if wanted != active:
                self.bring(wanted)
        except (LinkError, MapFormatError, StoreError) as error:
            if active is not None:
                return ReadyVersion(active, f"version {active.version} goes on: {error}")
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
        self._begun = ""
        manifest = self.manifest(wanted)
        self._cache.reserve(self._site, _addresses(manifest, wanted))
        self.vocabulary(manifest)
        for entry in manifest.tiles:
            # Decoded to check it, and not kept: a large site is larger than a robot's memory.
            checked_tile(entry, manifest.tile_size_m, self.blob(entry.sha256, entry.bytes))
        if self.takes_grids:
            self._fetch_grid(manifest)
        return manifest

    def activate(self, manifest: Manifest, wanted: WantedVersion) -> None:
        """Makes a fetched version the one that the robot starts with; raises StoreError where a piece of it is missing."""
        addresses = [*_addresses(manifest, wanted), *self._grid_addresses(manifest)]
        self._cache.activate(self._site, manifest.version, addresses)

    # --- contents of a version ----------------------------------------------------------------------------------------

    def manifest(self, wanted: WantedVersion) -> Manifest:
        """The wanted version's manifest, from the cache or the server.

        Raises LinkError where the site has no version or nobody answers, UntrustedError where signed lists do not admit it,
        MapFormatError for bytes that are not the wanted ones.
        """
        version, sha256 = address_of(wanted)
        active = self._cache.active(self._site)
        is_active = active is not None and sha256 == active.blobs[0]
        max_bytes = MAX_MANIFEST_BYTES if is_active else self._admitted_bytes(wanted, sha256)
        return checked_manifest(self._blob(self._key(f"manifests/{version}"), sha256, max_bytes), wanted)

    def blob(self, sha256: str, max_bytes: int = 0) -> bytes:
        """The verified bytes of an address, from the cache or the server; errors as of `manifest`."""
        return self._blob(self._key(f"blobs/{sha256}"), sha256, max_bytes)

    def tiles(self, manifest: Manifest, cells: Iterable[tuple[int, int]] | None = None) -> FetchedTiles:
        """As of MapSource, from the cache or the server. Once nobody answers, only the cache is asked, so that a robot without a
        network does not wait for every tile."""
        self._away = None
        return super().tiles(manifest, cells)

    def _tile_bytes(self, entry: TileEntry) -> bytes:
        if self._away is not None and entry.sha256 not in self._cache:
            raise self._away
        try:
            return super()._tile_bytes(entry)
        except UnreachableError as error:
            self._away = error
            raise

    def _fetch_grid(self, manifest: Manifest) -> None:
        """A version without its grid is as good for the robot as any; what is missing is missing for planners."""
        try:
            for entry in grid_blobs(manifest, self.blob):
                self.blob(entry.sha256, entry.bytes)
        except UnreachableError:
            raise
        except (LinkError, MapFormatError) as error:
            _log.warning("version %s comes without its grid for planners: %s", manifest.version, error)

    def _grid_addresses(self, manifest: Manifest) -> list[str]:
        """Of a grid that is whole in the cache; nothing otherwise."""
        with suppress(LinkError, MapFormatError):
            found = [entry.sha256 for entry in grid_blobs(manifest, self._cached)]
            index = grid_index(manifest)
            if index is not None and all(sha256 in self._cache for sha256 in found):
                return [index, *found]
        return []

    def _cached(self, sha256: str, _: int) -> bytes:
        data = self._cache.get(sha256)
        if data is None:
            raise LinkError(f"{sha256} is not in the cache")
        return data

    def _admitted_bytes(self, wanted: WantedVersion, sha256: str) -> int:
        """The manifest's size by the signed list. All else of a version follows from its manifest, by hash and size.

        A version whose fetch was admitted is finished, also where the list has gone on meanwhile.
        """
        if self._trust is None or sha256 == self._begun:
            return MAX_MANIFEST_BYTES
        length = self._trust.admitted(wanted).length
        self._begun = sha256
        return length

    def _blob(self, key: str, sha256: str, max_bytes: int) -> bytes:
        """The verified bytes of an address, from the cache or the server; cached afterwards."""
        data = self._cache.get(sha256)
        if data is None:
            data = verified(self._chunks.read(key, max_bytes=max_bytes), sha256)
            self._cache.put(sha256, data)
        return data

    # --- what a site keeps beside its versions ------------------------------------------------------------------------

    def site_file(self, kind: str, max_bytes: int) -> bytes | None:
        """What the last fresh signed list names of this kind, or what was kept before; None where the site has none.

        Errors as of `manifest`; what was kept stays.
        """
        kept = self._cache.kept_file(self._site, kind)
        named = None if self._trust is None else self._trust.files
        if named is None or (kept is not None and sha256_hex(kept) == named.get(kind)):
            return kept
        data = None
        if (sha256 := named.get(kind)) is not None:
            data = verified(self._chunks.read(self._key(f"blobs/{sha256}"), max_bytes=max_bytes), sha256)
        self._cache.keep_file(self._site, kind, data)
        return data

    def building_frame(self) -> BuildingFrame | None:
        """Where the site's map lies in its building, by `site_file`; None where the manifest of each version says it."""
        data = self.site_file(ALIGNMENT, _MAX_ALIGNMENT_BYTES)
        return None if data is None else aligned_frame(data)

    # --- reports ------------------------------------------------------------------------------------------------------

    def announce_presence(self) -> Handle:
        """Shows the server that this robot is there, until the handle or the bus is closed."""
        return self._bus.declare_alive(self._key("alive"))

    def ack(self, version: int | None, *, stamp_ns: int, refused: str = "") -> None:
        """Tells the server which version this robot runs and, if so, why not the wanted one."""
        own = {"site": self._site, "robot": self._robot}
        message = RobotAck(**own, stamp_ns=stamp_ns, version=version, refused=refused[:2000])
        self._bus.publish(self._key("ack"), encode_message(message))

    def report_failure(self, payload: bytes) -> FailureAck:
        """The server's answer to an encoded FailureReport, once it is on its disk; errors as of `wanted`."""
        return decode_message(self._bus.get(self._key("failures"), payload, timeout_s=self._timeout_s), FailureAck)

    def send_replay_part(self, part: ReplayPart) -> FailureAck:
        """How much of a failure's recording the server has; errors as of `wanted`."""
        answer = self._bus.get(self._key("replays"), encode_message(part), timeout_s=self._timeout_s)
        return decode_message(answer, FailureAck)

    def publish_health(self, health: RobotHealth) -> None:
        self._bus.publish(self._key("health"), encode_message(health))

    def publish_pose(self, message: PoseMessage) -> None:
        """Sends an estimate, which may be dropped when the network is full: the next one replaces it."""
        self._bus.publish(self._key("pose"), encode_message(message), may_drop=True)

    def _key(self, name: str) -> str:
        return robot_key(self._site, self._robot, name)


def _addresses(manifest: Manifest, wanted: WantedVersion) -> list[str]:
    """All blobs of a version, its manifest first; without a vocabulary that ships with the program."""
    vocabulary = manifest.vocabulary.sha256
    words = [] if shipped_vocabulary(vocabulary) else [vocabulary]
    return [wanted.manifest_sha256 or "", *words, *(tile.sha256 for tile in manifest.tiles)]
