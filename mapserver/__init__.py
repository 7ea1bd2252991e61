"""The map server: maps from recordings, kept as versions, served to robots.

As a library:

    from mapserver import build_map, open_map

    draft = build_map(["drive.mcap"], "maps", "hall")
    draft.publish()
    print(open_map("maps", "hall").points_map.shape)

The names are imported when they are first used, so that `import mapserver` and `mapserver --help` stay light.
"""

import importlib
from typing import TYPE_CHECKING, Any

from fleetmap.errors import FleetmapError

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


def __getattr__(name: str) -> Any:
    """Return a public name of the library (PEP 562). Raises FleetmapError if the server's libraries are not installed."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "__version__":  # read from the installation's metadata
        return importlib.import_module("fleetmap").__version__
    try:
        return getattr(importlib.import_module("mapserver.library"), name)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in ("fleetmap", "mapserver"):
            raise
        raise FleetmapError(
            f"mapserver.{name} needs {error.name}, which is not installed; "
            "pip install '.[server]' in fleetmap's source folder"
        ) from error


def __dir__() -> list[str]:
    return sorted(__all__)
