"""Plug-ins: what an installed distribution registers by entry points, in groups called hooks. This is the hook of either side:

| group | registered by the name of | as |
|---|---|---|
| `fleetmap.recordings` | the format | `RecordingFormat` of `fleetmap/recordings/__init__.py`; takes the place of one of the same name |

Those of a robot are in `locclient/hooks.py`, those of the map server in `mapserver/hooks.py`.
"""

from importlib.metadata import entry_points
from typing import Any

from fleetmap.errors import UsageError


def plugin(group: str, name: str, what: str) -> Any:
    """Return what is registered in a group by that name. UsageError without it; what: the feature that needs it."""
    found = plugins(group)
    if name not in found:
        raise UsageError(f"{what} needs a plug-in that is not installed: an entry point {name} of {group}")
    return found[name]


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
