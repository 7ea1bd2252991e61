"""The state that odometry estimates, and what it begins with."""

from dataclasses import dataclass, field

import numpy as np

from fleetmap.geometry import Array, se3, so3_exp


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

    def correct(self, error: Array) -> None:
        """Applies an error (15,) of the filter's convention: rotation, velocity, position, gyro bias, accelerometer bias."""
        turn = so3_exp(error[0:3])
        self.rotation = turn @ self.rotation
        self.velocity_mps = turn @ self.velocity_mps + error[3:6]
        self.position_m = turn @ self.position_m + error[6:9]
        self.gyro_bias_radps = self.gyro_bias_radps + error[9:12]
        self.accel_bias_mps2 = self.accel_bias_mps2 + error[12:15]


@dataclass(frozen=True, slots=True)
class InitialState:
    """A first state with covariance (15, 15) in the filter's error, valid at stamp_ns."""

    state: NavState
    covariance: Array
    stamp_ns: int
