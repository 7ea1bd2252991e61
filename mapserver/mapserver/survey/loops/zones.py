"""Hard zones of a site: places in different zones never see each other, whatever the pictures say."""

from dataclasses import dataclass, field

import numpy as np

from fleetmap.geometry import Array


@dataclass(frozen=True, slots=True)
class Zones:
    """Named polygons (V, 2) in `map`, metres. A place outside all of them is compatible with every other."""

    polygons: dict[str, Array] = field(default_factory=dict)

    def at(self, position_m: Array) -> frozenset[str]:
        """Names of the zones that hold a position (x, y, ...)."""
        return frozenset(name for name, polygon in self.polygons.items() if _inside(polygon, position_m))

    def compatible(self, a_m: Array, b_m: Array) -> bool:
        """Whether two positions may see the same."""
        zones_a, zones_b = self.at(a_m), self.at(b_m)
        return not zones_a or not zones_b or bool(zones_a & zones_b)


def _inside(polygon: Array, position_m: Array) -> bool:
    """Even-odd rule."""
    x, y = float(position_m[0]), float(position_m[1])
    inside = False
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            inside = not inside
    return inside
