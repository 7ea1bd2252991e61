"""Connection of a command to its map: over the bus, or in a store's folder."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fleetmap.bus import ZenohBus
from locclient.maps.map_client import LocalMapSource, MapClient, MapSource
from locclient.maps.tile_cache import StoreFolder, TileCache

_log = logging.getLogger(__name__)
_PATIENCE_S = 120.0  # with a server that goes away in the middle of a fetch; one that is restarted is back by then


@dataclass(frozen=True)
class MapConnection:
    """What a robot reads its map from, and the client that it reports with; None where it reads a store's folder."""

    source: MapSource
    client: MapClient | None
    site: str
    robot: str


@contextmanager
def connected(options: dict[str, Any]) -> Iterator[MapConnection]:
    """A link for the options `server` or `store`, `site`, `robot`, `cache`, `cache_bytes`; closed afterwards."""
    site, robot = options["site"], options["robot"]
    if options["store"] is not None:
        yield MapConnection(LocalMapSource(StoreFolder(Path(options["store"])), site), None, site, robot)
        return
    folder = Path(options["cache"]) if options["cache"] is not None else default_cache_folder()
    bus = ZenohBus.connect(options["server"])
    try:
        cache = TileCache(folder, max_bytes=options["cache_bytes"])
        link = MapClient(bus, cache, site, robot, patience_s=_PATIENCE_S)
        link.announce_presence()
        yield MapConnection(link, link, site, robot)
        for fault in cache.take_faults():
            _log.warning("tile cache: %s", fault)
    finally:
        bus.close()


def default_cache_folder() -> Path:
    """`fleetmap/tiles` in the user's cache folder (XDG_CACHE_HOME)."""
    return Path(os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))) / "fleetmap" / "tiles"
