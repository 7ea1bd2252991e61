"""Result of odometry for one frame, and a coordinate frame in which results are continuous."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from fleetmap.geometry import Array, Indices, se3_inverse
from fleetmap.sensors.samples import PAUSE_NS


class OdometryStatus(StrEnum):
    """Reliability of an estimate."""

    INITIALISING = "initialising"
    TRACKING = "tracking"
    DEGRADED = "degraded"


@dataclass(frozen=True, slots=True)
class OdometryEstimate:
    """Estimated state of the body at one frame.

    odom_from_body (4, 4); cov_rot_trans (6, 6) in odom axes; velocity, biases (3,), zero if unknown. track_ids (N,) of the observed points,
    track_pixels (N, 3), u_left v u_right (None for an odometry without tracks);
    after_gap: they were matched by descriptors; inertial: gravity is known. new_odom_from_old_odom is
    given when the frame `odom` was redefined (gravity found): earlier estimates must be multiplied by it from the left.
    previous_from_body (4, 4) is the current estimate of the motion since the frame before, None if unknown. It differs from that of two
    successive estimates: improved knowledge of gravity rotates `odom` about its origin, far from the body.
    imu_minus_cam_s is the estimated time offset, 0 without an IMU, and imu_minus_cam_sigma_s its standard deviation.
    scale_known is False for one camera of unknown scale: lengths are then in an arbitrary unit. revised:
    earlier frames with new poses, (frame index, odom_from_body (4, 4)). is_lifted: a ground robot leaves the ground. is_bridged: samples of
    the IMU are missing since the frame before, the images alone show the motion. cam_from_previous (4, 4): motion since the frame before by
    the images alone, None if they do not show it.
    """

    stamp_ns: int
    frame_index: int
    odom_from_body: Array
    cov_rot_trans: Array
    status: OdometryStatus
    velocity_odom_mps: Array = field(default_factory=lambda: np.zeros(3))
    gyro_bias_radps: Array = field(default_factory=lambda: np.zeros(3))
    accel_bias_mps2: Array = field(default_factory=lambda: np.zeros(3))
    track_ids: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    scene_depth_m: float = 5.0
    inlier_share: float = 1.0
    after_gap: bool = False
    inertial: bool = False
    new_odom_from_old_odom: Array | None = None
    scale_known: bool = True
    revised: tuple[tuple[int, Array], ...] = ()
    imu_minus_cam_s: float = 0.0
    imu_minus_cam_sigma_s: float = np.inf
    track_pixels: Array | None = None
    previous_from_body: Array | None = None
    is_lifted: bool = False
    is_bridged: bool = False
    cam_from_previous: Array | None = None


def is_away(last_ns: int, estimate: OdometryEstimate) -> bool:
    """True if no motion links an estimate to the one at last_ns, before a pause: the robot may have been carried anywhere."""
    is_pause = estimate.stamp_ns - last_ns > PAUSE_NS
    return is_pause and not estimate.inertial and estimate.status is OdometryStatus.DEGRADED


class ContinuousFrame:
    """Chains estimates by the motion between them.

    The odometry's own frame rotates about its origin whenever gravity becomes better known: after 17 m a third of a degree in a first
    bend moves every pose by 10 cm. frame_from_odom (4, 4) compensates for that; it may be set to restart.
    """

    def __init__(self) -> None:
        self.frame_from_odom = np.eye(4)
        self._frame_from_last: Array | None = None

    def handle(self, estimate: OdometryEstimate) -> Array:
        """frame_from_body (4, 4) at the estimate's frame."""
        motion, change = estimate.previous_from_body, estimate.new_odom_from_old_odom
        if self._frame_from_last is None:
            pass  # no state to continue from
        elif motion is not None:
            self.frame_from_odom = self._frame_from_last @ motion @ se3_inverse(estimate.odom_from_body)
        elif change is not None:
            self.frame_from_odom = self.frame_from_odom @ se3_inverse(change)
        self._frame_from_last = np.asarray(self.frame_from_odom @ estimate.odom_from_body)
        return self._frame_from_last
