"""What the IMU says about motion between two moments."""

from fleetmap.inertial.preintegration import (
    GRAVITY_MAP,
    GRAVITY_MPS2,
    NavTrack,
    Preintegrated,
    imu_intervals,
    preintegrate,
    propagate_nav,
)

__all__ = ["GRAVITY_MAP", "GRAVITY_MPS2", "NavTrack", "Preintegrated", "imu_intervals", "preintegrate", "propagate_nav"]
