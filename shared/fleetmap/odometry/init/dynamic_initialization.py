"""Dynamic initialization: stereo odometry in motion, aligned to the IMU."""

from fleetmap.odometry.init.imu_alignment import VisualMotion, align, initial_state
from fleetmap.odometry.init.initial_state import InitialState
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples, Trajectory


def dynamic_initialization(
    vision: Trajectory, imu: ImuSamples, noise: ImuNoise, settings: OdometrySettings
) -> InitialState | None:
    """Aligns visual odometry (metric, body transforms in any frame) with the IMU, see `imu_alignment`.

    None where the alignment does not give gravity its size.
    """
    stamps = [int(stamp) for stamp in vision.stamps_ns]
    rotations = vision.frame_from_body[:, :3, :3]
    motion = VisualMotion(stamps, rotations, vision.positions_m, None, 0.004, 0.04, (200.0, 20.0))
    found = align(motion, imu, noise, settings, gravity_slack=2.0, steps=4)
    return None if found is None else initial_state(vision, found)
