"""The map server: maps from recordings, kept as versions, served to robots.

As a library:

    from mapserver import build_map, open_map

    draft = build_map(["drive.mcap"], "maps", "hall")
    draft.publish()
    print(open_map("maps", "hall").points_map.shape)

The names are imported when they are first used, so that `import mapserver` and `mapserver --help` stay light.
"""

from typing import TYPE_CHECKING

from fleetmap.lazy_names import lazy_names

if TYPE_CHECKING:
    from fleetmap.version import __version__ as __version__
    from mapserver.library import Actor as Actor
    from mapserver.library import BuildOptions as BuildOptions
    from mapserver.library import BuiltMap as BuiltMap
    from mapserver.library import GateSettings as GateSettings
    from mapserver.library import MapArrays as MapArrays
    from mapserver.library import MapStore as MapStore
    from mapserver.library import build_map as build_map
    from mapserver.library import open_map as open_map
    from mapserver.library import open_store as open_store

_NAMES = {
    "fleetmap.version": "__version__",
    "mapserver.library": "Actor BuildOptions BuiltMap GateSettings MapArrays MapStore build_map open_map open_store",
}
__all__, __getattr__, __dir__ = lazy_names(__name__, _NAMES, extra="server")
