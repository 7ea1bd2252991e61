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
    from fleetmap.version import __version__
    from mapserver.library import (
        Actor,
        BuildOptions,
        BuiltMap,
        GateSettings,
        MapArrays,
        MapStore,
        build_map,
        open_map,
        open_store,
    )

__all__ = ["Actor", "BuildOptions", "BuiltMap", "GateSettings", "MapArrays", "MapStore", "build_map", "open_map"]
__all__ += ["__version__", "open_store"]
_NAMES = {"mapserver.library": " ".join(__all__), "fleetmap.version": "__version__"}  # the last one has it
__getattr__, __dir__ = lazy_names(__name__, _NAMES, extra="server")
