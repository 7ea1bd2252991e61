"""The zones of a site from a TOML file: a table [zones] with name = [[x, y], ...] in metres."""

from pathlib import Path

import msgspec
import numpy as np

from fleetmap.config import Section, load_toml
from fleetmap.errors import UsageError
from mapserver.survey.loops.zones import Zones


class _ZonesFile(Section, frozen=True):
    zones: dict[str, object]


def read_zones(path: Path) -> Zones:
    """The polygons in the file at `path`.

    Raises UsageError, naming the file and the zone, for anything but three or more corners of two finite numbers each.
    """
    named = load_toml(path, _ZonesFile).zones
    if not named:
        raise UsageError(f"{path}: the table [zones] is empty; write name = [[x, y], ...] or leave --zones out")
    polygons = {}
    for name, value in named.items():
        where = f"{path}: zone {name!r}"
        try:
            corners = msgspec.convert(value, list[tuple[float, float]])
        except msgspec.ValidationError as error:
            raise UsageError(f"{where}: {error}; write it as a list of corners [x, y] in metres") from error
        if len(corners) < 3:
            raise UsageError(f"{where} has {len(corners)} corner(s); an area needs at least 3")
        polygon = np.array(corners, dtype=np.float64)
        if not np.isfinite(polygon).all():
            raise UsageError(f"{where} has a corner that is not finite: {corners}; write metres")
        polygons[name] = polygon
    return Zones(polygons)
