"""Plug-ins: what an installed distribution registers by entry points. The groups are hooks: see `hooks.py` of either side."""

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
