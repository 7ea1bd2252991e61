"""What the IMU says about motion between two moments."""

from fleetmap.inertial.preintegration import (
    GRAVITY_MAP,
    GRAVITY_MPS2,
    Preintegrated,
    imu_intervals,
    preintegrate,
)

__all__ = ["GRAVITY_MAP", "GRAVITY_MPS2", "Preintegrated", "imu_intervals", "preintegrate"]
