"""The first state of the filter."""

from dataclasses import dataclass

from fleetmap.geometry import Array
from fleetmap.odometry.filter.nav_state import NavState


@dataclass(frozen=True, slots=True)
class InitialState:
    """A first state with covariance (15, 15) in the filter's error, valid at stamp_ns."""

    state: NavState
    covariance: Array
    stamp_ns: int
