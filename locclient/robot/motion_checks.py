"""A robot's speed by wheels or odometry, and what disagrees: wheels and IMU with the images, estimates with docks. Pure."""

from collections.abc import Iterable, Sequence
from math import dist, hypot

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import Flag, Status
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.sensors.samples import PositionPrior, WheelSample
from locclient.localization.estimate import Estimate

_EXACT_M = 0.1  # sigma up to which a position prior is a dock's; three sigmas are the limit of a failure
_LEFT_M = 1.0  # distance travelled after which the next report of a dock is another arrival
_STALE_M = 0.05  # distance travelled between a dock's report and the frame beyond which the two cannot be compared


class DockCheck:
    """Compares the reports of docks with estimates that were TRACKING before; once for each arrival."""

    def __init__(self, base_from_body: Array) -> None:
        self._body_from_base = se3_inverse(base_from_body)
        self._was_tracking = False
        self._last_m: Array | None = None
        self._path_m = np.inf

    def handle(self, priors: Iterable[PositionPrior], estimate: Estimate) -> float | None:
        """Horizontal distance between the estimate of a frame and the dock among the priors that came with it.

        None without a dock, where the robot was not TRACKING, and for docks that repeat themselves while it stands.
        """
        self._follow(estimate)
        was_tracking, self._was_tracking = self._was_tracking, estimate.status is Status.TRACKING
        exact = [prior for prior in priors if _is_exact(prior)]
        if not exact:
            return None
        arrives, self._path_m = self._path_m > _LEFT_M, 0.0
        dock = exact[-1]
        speed_mps = float(np.linalg.norm(estimate.odometry.velocity_odom_mps))
        is_stale = speed_mps * abs(estimate.stamp_ns - dock.stamp_ns) * 1e-9 > _STALE_M
        if not (arrives and was_tracking and self._was_tracking) or is_stale or estimate.map_from_body is None:
            return None
        map_from_base = estimate.map_from_body @ self._body_from_base
        return float(np.linalg.norm(map_from_base[:2, 3] - dock.map_from_base[:2, 3]))

    def _follow(self, estimate: Estimate) -> None:
        """Counts the distance travelled, also where the odometry redefines its frame."""
        now_m, change = estimate.odometry.odom_from_body[:3, 3], estimate.odometry.new_odom_from_old_odom
        if self._last_m is not None:
            last_m = self._last_m if change is None else change[:3, :3] @ self._last_m + change[:3, 3]
            self._path_m += float(np.linalg.norm(now_m - last_m))
        self._last_m = now_m


def _is_exact(prior: PositionPrior) -> bool:
    """Whether this is a dock's report, not a zone or an operator's estimate."""
    covariance = prior.cov_rot_trans[3:5, 3:5]
    return not prior.is_revisable and bool(
        np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[-1] <= _EXACT_M**2
    )


_WHEEL_NS = 500_000_000  # age from which wheel odometry says nothing of the present
_SPAN_NS = 500_000_000  # over which a camera's motion is measured: a millimetre of noise is 2 mm/s


class SpeedGauge:
    """Follows one robot frame by frame."""

    def __init__(self) -> None:
        self._wheel: WheelSample | None = None
        self._from: tuple[int, Array] | None = None
        self._camera_mps: float | None = None

    def handle(self, wheel: Sequence[WheelSample], odometry: OdometryEstimate, odom_from_base: Array) -> float | None:
        """Metres a second at a frame; None where neither wheels nor odometry know it.

        wheel: since the frame before. odom_from_base (4, 4): in an odometry frame that is never redefined. Without an IMU the odometry
        estimates no velocity, and the distance moved within half a second gives it.
        """
        self._wheel = wheel[-1] if wheel else self._wheel
        self._measure(odometry, odom_from_base)
        if self._wheel is not None and abs(odometry.stamp_ns - self._wheel.stamp_ns) <= _WHEEL_NS:
            return hypot(*self._wheel.velocity_base_mps[:2])
        if not odometry.scale_known:
            return None
        return hypot(*odometry.velocity_odom_mps) if odometry.inertial else self._camera_mps

    def _measure(self, odometry: OdometryEstimate, odom_from_base: Array) -> None:
        """Distance over time between frames at least _SPAN_NS apart; unknown while the odometry does not hold."""
        if odometry.status is OdometryStatus.DEGRADED:
            self._from = self._camera_mps = None
            return
        place = (odometry.stamp_ns, odom_from_base[:3, 3])
        if self._from is None:
            self._from = place
        elif place[0] - self._from[0] >= _SPAN_NS:
            self._camera_mps = dist(place[1], self._from[1]) / ((place[0] - self._from[0]) * 1e-9)
            self._from = place


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
