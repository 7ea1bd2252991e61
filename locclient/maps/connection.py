"""Connection of a command to its map, over the bus or in a store's folder."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fleetmap.bus.endpoints import is_loopback
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import UsageError, disk_errors
from fleetmap.trust import TrustedMap, ask_over
from locclient.identity import MapAddress
from locclient.maps.map_client import MapClient
from locclient.maps.map_source import LocalMapSource, MapSource
from locclient.maps.tile_cache import DEFAULT_MAX_BYTES, TileCache

_log = logging.getLogger(__name__)
_NOWHERE = "tcp/127.0.0.1:7447"
_PATIENCE_S = 120.0  # without an answer during a fetch; long enough for a server's restart


def open_bus(address: MapAddress) -> Bus:
    """Open a connection to the server, with the robot's identity if it has one. Without a server the bus stays closed."""
    return Bus(_NOWHERE) if address.server is None else Bus.connect(str(address.server), tls=address.tls)


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
) -> Iterator[MapSource]:
    """Open the maps of an address, with a cache of at most so many bytes; close them afterwards."""
    if address.store is not None:
        yield LocalMapSource(Path(address.store), address.site, address.version)
        return
    cache = TileCache(cache_folder(cache_setting), max_bytes=cache_bytes)
    with open_bus(address) as bus:
        yield map_client(bus, cache, address)
        for fault in cache.take_faults():
            _log.warning("tile cache: %s", fault)


def outbox_path(site: str, robot: str, cache: str | Path | None = None) -> Path:
    """Return the file of the outbox beside the tile cache, one for each robot of the machine."""
    return cache_folder(cache).parent / "spool" / f"{site}.{robot}.sqlite3"


def replay_outbox(outbox: Path) -> Path:
    """Return the outbox file of failure recordings, beside that of reports."""
    return outbox.with_name(f"{outbox.stem}.replays{outbox.suffix}")


def cache_folder(setting: str | Path | None = None) -> Path:
    """Return the folder of the setting `cache`, else `fleetmap/tiles` in the user's cache folder (XDG_CACHE_HOME)."""
    if setting is not None:
        return Path(setting)
    return Path(os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))) / "fleetmap" / "tiles"
