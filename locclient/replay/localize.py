"""Localization of a recording in a published map, as one call."""

import re
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2

from fleetmap.errors import UsageError
from fleetmap.recordings import FrameSelection, OpenOptions, Recording, Topics, open_recording
from fleetmap.sensors.samples import PositionPrior
from fleetmap.sources.replay_source import ReplaySource
from locclient.identity import GivenAddress, MapAddress
from locclient.maps.connection import connected
from locclient.maps.loaded_map import LoadedMap
from locclient.maps.tile_cache import DEFAULT_MAX_BYTES
from locclient.replay.replay import ReplayOptions, load_map, replay
from locclient.replay.run_result import ReplayResult

_ENDPOINT = re.compile(r"(tcp|tls|udp|quic|ws|unixsock-stream)/")


@dataclass(frozen=True)
class LocalizeOptions(ReplayOptions):
    """Options of `localize` beside those of every replay.

    frames: which of the recording's, as a Python slice. reverse: backwards, with new stamps and without IMU. calibration, topics: for
    opening a recording by its path. robot: the name that the server sees, `replay` unless it has an identity. root, identity,
    insecure: as of the command. cache, cache_bytes: folder and size of the tile cache. version: of a store's folder, drafts too.
    """

    frames: str = ":"
    reverse: bool = False
    calibration: Path | None = None
    topics: Topics = field(default_factory=Topics)
    robot: str | None = None
    root: Path | None = None
    identity: Path | None = None
    insecure: bool = False
    cache: Path | None = None
    cache_bytes: int = DEFAULT_MAX_BYTES
    version: int | None = None


_DEFAULTS = LocalizeOptions()


def localize(
    recording: str | Path | Recording,
    maps: str | Path,
    site: str,
    *,
    prior: PositionPrior | None = None,
    options: LocalizeOptions = _DEFAULTS,
) -> ReplayResult:
    """Localizes every frame of a recording in the current map of a site, as a robot would.

    recording: its path, or one that is open. maps: folder of a store, or endpoint of a server, such as tcp/127.0.0.1:7447.
    prior: a coarse pose at the beginning. Raises FleetmapError for whatever cannot be opened, read or fetched.
    """
    with ExitStack() as stack:
        if not isinstance(recording, Recording):
            how = OpenOptions(calibration_file=options.calibration, topics=options.topics)
            recording = stack.enter_context(open_recording(Path(recording), how))
        selection = FrameSelection.parse(options.frames)
        address = _address(maps, site, options)
        connection = stack.enter_context(connected(address, options.cache, options.cache_bytes))
        source = ReplaySource.of(recording, selection, reverse=options.reverse)
        stack.callback(cv2.setNumThreads, cv2.getNumThreads())
        return replay(source, connection, options, prior)


def fetch_map(maps: str | Path, site: str, options: LocalizeOptions = _DEFAULTS) -> LoadedMap:
    """The current map of a site with all of its tiles, for a `MapView`; arguments and errors as of `localize`."""
    with connected(_address(maps, site, options), options.cache, options.cache_bytes) as connection:
        return load_map(connection.source)[0]


def _address(maps: str | Path, site: str, options: LocalizeOptions) -> MapAddress:
    is_server = isinstance(maps, str) and _ENDPOINT.match(maps) is not None
    if is_server and options.version is not None:
        raise UsageError(
            f"version {options.version} needs a store's folder: a server gives the one that its robots should run"
        )
    address = GivenAddress(
        site=site,
        robot=options.robot,
        server=str(maps) if is_server else None,
        store=None if is_server else str(maps),
        root=None if options.root is None else str(options.root),
        identity=None if options.identity is None else str(options.identity),
        insecure=options.insecure,
    ).resolve("replay")
    return replace(address, version=options.version)
