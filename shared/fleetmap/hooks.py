"""Plug-ins: what an installed distribution registers by entry points, in groups called hooks. This is the hook of either side:

| group | registered by the name of | as |
|---|---|---|
| `fleetmap.recordings` | the format | `RecordingFormat` of `fleetmap/recordings/__init__.py`; takes the place of one of the same name |

Those of a robot are in `locclient/hooks.py`, those of the map server in `mapserver/hooks.py`.
"""

from importlib.metadata import entry_points
from typing import Any


def plugins(group: str) -> dict[str, Any]:
    """Return what is registered in a group, by name, in order. Whose folder was deleted is not installed."""
    found = {}
    for point in sorted(entry_points(group=group)):
        try:
            found[point.name] = point.load()
        except ModuleNotFoundError as error:
            if not f"{point.module}.".startswith(f"{error.name}."):  # a library that the plug-in needs
                raise
    return found
