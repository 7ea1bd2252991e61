"""Initialization of one camera with an IMU in motion: scale, direction of gravity, velocity."""

from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array
from fleetmap.odometry.init.imu_alignment import VisualMotion, align, initial_state
from fleetmap.odometry.init.initial_state import InitialState
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples, Trajectory

_POSITION_SIGMA_M, _VELOCITY_SIGMA_MPS = 0.006, 0.04


@dataclass(frozen=True, slots=True)
class MonoInertialStart:
    """A first state, the metres in one unit of vision, and the standard deviation of that as a share of it."""

    start: InitialState
    metres_per_unit: float
    scale_sigma_share: float


def mono_inertial_initialization(
    vision: Trajectory, imu: ImuSamples, noise: ImuNoise, body_from_cam: Array, settings: OdometrySettings
) -> MonoInertialStart | None:
    """Aligns a camera's way up to scale with the IMU's, see `imu_alignment`.

    vision holds vision_from_cam at IMU stamps. None where the motion does not show the scale to within the settings' share, or
    where what fits is no gravity.
    """
    stamps = [int(stamp) for stamp in vision.stamps_ns]
    rotations = vision.frame_from_body[:, :3, :3] @ body_from_cam[:3, :3].T  # vision_from_body
    levers_m, weights = -rotations @ body_from_cam[:3, 3], (1 / _POSITION_SIGMA_M, 1 / _VELOCITY_SIGMA_MPS)
    motion = VisualMotion(
        stamps, rotations, levers_m, vision.positions_m, _POSITION_SIGMA_M, _VELOCITY_SIGMA_MPS, weights
    )
    found = align(motion, imu, noise, settings, gravity_slack=3.0, steps=5)
    if found is None:
        return None
    scale, sigma = float(found.solution[5]), float(np.sqrt(found.covariance[5, 5]))
    if scale <= 0 or sigma > settings.monocular.max_scale_sigma_share * scale:
        return None
    vision_from_body = np.tile(np.eye(4), (len(vision), 1, 1))
    vision_from_body[:, :3, :3] = rotations
    vision_from_body[:, :3, 3] = scale * vision.positions_m + levers_m
    start = initial_state(Trajectory(vision.stamps_ns, vision_from_body), found)
    return MonoInertialStart(start, scale, sigma / scale)
