"""The result of odometry for one frame, and a frame in which results follow each other without a jump."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.samples import PAUSE_NS


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
    earlier frames that are placed anew, (frame index, odom_from_body (4, 4)). is_lifted: a robot with wheels leaves its floor.
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
    is_lifted: bool = False


def is_away(last_ns: int, estimate: OdometryEstimate) -> bool:
    """True if nothing ties an estimate to the one at last_ns, a pause before it: the robot may have been carried anywhere."""
    is_pause = estimate.stamp_ns - last_ns > PAUSE_NS
    return is_pause and not estimate.inertial and estimate.status is OdometryStatus.DEGRADED


class ContinuousFrame:
    """Follows estimates one after the other by the motion between them.

    The odometry's own frame turns about its origin whenever gravity becomes better known: after 17 m a third of a degree in a first
    bend moves every pose by 10 cm. frame_from_odom (4, 4) takes that up; it may be set to begin anew.
    """

    def __init__(self) -> None:
        self.frame_from_odom = np.eye(4)
        self._frame_from_last: Array | None = None

    def handle(self, estimate: OdometryEstimate) -> Array:
        """frame_from_body (4, 4) at the estimate's frame."""
        motion, change = estimate.previous_from_body, estimate.new_odom_from_old_odom
        if self._frame_from_last is None:
            pass  # nothing to go on from
        elif motion is not None:
            self.frame_from_odom = self._frame_from_last @ motion @ se3_inverse(estimate.odom_from_body)
        elif change is not None:
            self.frame_from_odom = self.frame_from_odom @ se3_inverse(change)
        self._frame_from_last = np.asarray(self.frame_from_odom @ estimate.odom_from_body)
        return self._frame_from_last
