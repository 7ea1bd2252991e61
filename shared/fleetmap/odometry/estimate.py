"""The result of odometry for one frame."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array


class OdometryStatus(StrEnum):
    """Reliability of an estimate."""

    INITIALISING = "initialising"
    TRACKING = "tracking"
    DEGRADED = "degraded"


@dataclass(frozen=True, slots=True)
class OdometryEstimate:
    """The body at one frame.

    odom_from_body (4, 4); cov_rot_trans (6, 6) in odom axes; velocity, biases (3,). track_ids (N,) of the points seen and
    track_pixels (N, 3), u_left v u_right, where (None of an odometry that follows none);
    after_gap where they had to be matched by descriptors; inertial once gravity is known. new_odom_from_old_odom is
    given when the frame `odom` was redefined (gravity found): earlier estimates must be multiplied by it from the left.
    previous_from_body (4, 4) is the motion since the frame before, as known now, None where it is not known. It is not what two
    estimates differ by: gravity that becomes better known turns all of `odom` about its origin, far from where the body is.
    imu_minus_cam_s is the time offset as estimated so far, 0 without an IMU, and imu_minus_cam_sigma_s its standard deviation.
    scale_known is False for one camera whose scale nothing has shown: lengths are then in a unit of the odometry's own. revised:
    earlier frames that are placed anew, (frame index, odom_from_body (4, 4)).
    """

    stamp_ns: int
    frame_index: int
    odom_from_body: Array
    cov_rot_trans: Array
    velocity_odom_mps: Array
    gyro_bias_radps: Array
    accel_bias_mps2: Array
    status: OdometryStatus
    track_ids: NDArray[np.int64]
    scene_depth_m: float
    inlier_share: float
    after_gap: bool
    inertial: bool
    new_odom_from_old_odom: Array | None
    scale_known: bool = True
    revised: tuple[tuple[int, Array], ...] = ()
    imu_minus_cam_s: float = 0.0
    imu_minus_cam_sigma_s: float = np.inf
    track_pixels: Array | None = None
    previous_from_body: Array | None = None
