"""State of the odometry, and its initial value."""

from dataclasses import dataclass, field

import numpy as np

from fleetmap.geometry import Array, se3


@dataclass
class NavState:
    """Nominal state in `odom`."""

    rotation: Array = field(default_factory=lambda: np.eye(3))
    velocity_mps: Array = field(default_factory=lambda: np.zeros(3))
    position_m: Array = field(default_factory=lambda: np.zeros(3))
    gyro_bias_radps: Array = field(default_factory=lambda: np.zeros(3))
    accel_bias_mps2: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def odom_from_body(self) -> Array:
        """(4, 4)."""
        return se3(self.rotation, self.position_m)

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array, Array]:
        """All fields, in order."""
        return self.rotation, self.velocity_mps, self.position_m, self.gyro_bias_radps, self.accel_bias_mps2

    def copy(self) -> "NavState":
        """A deep copy."""
        return NavState(*(np.array(values, np.float64, order="C") for values in self.arrays))


@dataclass(frozen=True, slots=True)
class InitialState:
    """A first state with covariance (15, 15) in the filter's error, valid at stamp_ns."""

    state: NavState
    covariance: Array
    stamp_ns: int
