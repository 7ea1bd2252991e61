"""Hard zones of a site: cameras in different zones never see the same, whatever the pictures suggest."""

from dataclasses import dataclass, field

import msgspec
import numpy as np

from fleetmap.errors import UsageError
from fleetmap.geometry import Array, inside_rings


@dataclass(frozen=True, slots=True)
class Zones:
    """Named polygons (V, 2) in `map`, metres. A place outside all of them is compatible with every other."""

    polygons: dict[str, Array] = field(default_factory=dict)

    def at(self, position_m: Array) -> frozenset[str]:
        """Return the names of the zones that contain a position (x, y, ...)."""
        place = np.asarray(position_m[None, :2])
        return frozenset(name for name, polygon in self.polygons.items() if inside_rings(place, [polygon])[0])

    def compatible(self, a_m: Array, b_m: Array) -> bool:
        """True if two positions may see the same."""
        zones_a, zones_b = self.at(a_m), self.at(b_m)
        return not zones_a or not zones_b or bool(zones_a & zones_b)


def zones_of(named: dict[str, object], file: str) -> Zones:
    """Build zones from lists of corners [[x, y], ...] by name.

    Raises UsageError, naming the file and the zone, unless a zone has three or more corners of two finite numbers each.
    """
    if not named:
        raise UsageError(f"{file}: the table [zones] is empty; write name = [[x, y], ...] or leave --zones out")
    polygons = {}
    for name, value in named.items():
        where = f"{file}: zone {name!r}"
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
