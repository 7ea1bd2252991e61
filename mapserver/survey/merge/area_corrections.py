"""Areas of a published map in which operators limit what surveys change."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, Rings, inside_any

Mask = NDArray[np.bool_]
CLOCKS_BEGIN_NS = 946_684_800_000_000_000  # the year 2000: earlier stamps count from a start, not from 1970


@dataclass(frozen=True, slots=True)
class SurveyLimits:
    """Polygons by what surveys must not do there.

    frozen: neither add, move nor remove landmarks, nor move or add places. unused: add no landmarks. since: add no landmarks if the
    survey ended before a time, in nanoseconds since 1970.
    """

    frozen: tuple[Rings, ...] = ()
    unused: tuple[Rings, ...] = ()
    since: tuple[tuple[Rings, int], ...] = ()

    def freezes(self, points_map: Array) -> Mask:
        """Return (N,) which points (N, 3) lie in a frozen polygon."""
        return inside_any(points_map, self.frozen)

    def closes(self, points_map: Array, end_ns: int) -> Mask:
        """Return (N,) where a survey that ended at end_ns by its own clock may not add landmarks."""
        late = [rings for rings, since_ns in self.since if is_before(end_ns, since_ns)]
        return inside_any(points_map, (*self.frozen, *self.unused, *late))


def is_before(end_ns: int, since_ns: int) -> bool:
    """True if a recording's last stamp precedes a time; a clock that does not count from 1970 cannot tell."""
    return CLOCKS_BEGIN_NS < end_ns < since_ns
