"""IMU preintegration: motion between two moments from inertial samples."""

from fleetmap.inertial.preintegration import (
    GRAVITY_MAP,
    GRAVITY_MPS2,
    Preintegrated,
    imu_intervals,
    preintegrate,
)

__all__ = ["GRAVITY_MAP", "GRAVITY_MPS2", "Preintegrated", "imu_intervals", "preintegrate"]
