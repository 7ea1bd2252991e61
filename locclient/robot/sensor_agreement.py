"""Sensors that everything else contradicts while the robot drives: left out, and said. Pure."""

from collections.abc import Sequence

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import Flag
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.sensors.samples import WheelSample

_ASK = "record a drive and ask `mapserver doctor`"
WHEELS_REFUSED = {
    Flag.WHEELS_REFUSED: f"the wheels are left out: their speed contradicts the images and the IMU; {_ASK} how",
}
"""Flag of RobotHealth with its words: the camera's motion contradicts the sensor, which is not used."""


def imu_refused(late_s: float | None) -> dict[Flag, str]:
    """The flag of an IMU that is used no more, with its words. late_s: of its stamps by the images' turns, None if it is not that."""
    words = f"it turns otherwise than the images; {_ASK} which axis is wrong"
    if late_s is not None:
        when = (
            f"its stamps are about {abs(late_s):.2f} s {'late' if late_s > 0 else 'early'} by the turns of the images"
        )
        words = f"{when}; stamp both by one clock, or {_ASK} for the timeshift_cam_imu to set"
    return {Flag.IMU_REFUSED: f"the IMU is left out: {words}"}


def accelerometer_refused(fault: str) -> dict[Flag, str]:
    """The flag of an accelerometer with such a fault, with its words; empty without one."""
    words = f"the accelerometer is left out, the images contradict it: {fault}; mend its driver, or how the calibration mounts it"
    return {Flag.ACCELEROMETER_REFUSED: words} if fault else {}


_OFF_SHARE, _OFF_MPS = 0.5, 0.3  # of the speed, and of slow ones: slip of a tyre is far less
_LIMIT_M = 3.0  # of driving against the images: a spinning wheel or a person before the camera takes less
_FOLLOWED_SHARE = 0.5  # of the tracks
_REST_SHARE = 0.2  # wheels that rest may be those of a robot that is carried: that counts for so much


class WheelAgreement:
    """Follows wheels and odometry frame by frame.

    is_refused: they have contradicted each other for metres, and not agreed for as long since.
    """

    def __init__(self, base_from_body: Array) -> None:
        self._base_from_body = base_from_body
        self._last_ns: int | None = None
        self._against_m = 0.0
        self.is_refused = False

    def handle(self, wheel: Sequence[WheelSample], odometry: OdometryEstimate) -> None:
        """A frame; wheel: the samples since the one before."""
        last_ns, self._last_ns = self._last_ns, odometry.stamp_ns
        moved = odometry.previous_from_body
        # Pictures too far apart to be followed say nothing: then it is the odometry that may be wrong.
        is_followed = odometry.inlier_share >= _FOLLOWED_SHARE and not odometry.after_gap
        is_known = odometry.status is OdometryStatus.TRACKING and odometry.scale_known and is_followed
        if last_ns is None or not wheel or not is_known or moved is None:
            return
        duration_s = (odometry.stamp_ns - last_ns) * 1e-9
        seen_mps = (self._base_from_body @ moved @ se3_inverse(self._base_from_body))[:2, 3] / duration_s
        rolled_mps = np.mean([sample.velocity_base_mps[:2] for sample in wheel], axis=0)
        seen, rolled = float(np.linalg.norm(seen_mps)), float(np.linalg.norm(rolled_mps))
        step_m = min(max(seen, min(rolled, 1.0)), 10.0) * duration_s
        if np.linalg.norm(rolled_mps - seen_mps) > max(_OFF_MPS, _OFF_SHARE * min(seen, rolled)):
            self._against_m += step_m * (_REST_SHARE if rolled < 0.01 else 1.0)
        else:
            self._against_m -= step_m
        self._against_m = min(max(self._against_m, 0.0), 2.0 * _LIMIT_M)
        if self._against_m >= _LIMIT_M:
            self.is_refused = True
        elif self._against_m == 0.0:
            self.is_refused = False
