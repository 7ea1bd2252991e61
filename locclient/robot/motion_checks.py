"""Speed of a robot by wheels or odometry, its load, and consistency checks: wheels and IMU with images, estimates with docks. Pure."""

from cmath import phase, rect
from collections import deque
from collections.abc import Iterable, Sequence
from itertools import pairwise
from math import dist, hypot

import numpy as np

from fleetmap.geometry import Array, length, se3_inverse, so3_exp, so3_log
from fleetmap.messages import Flag, Status
from fleetmap.odometry.accelerometer_check import AccelerometerCheck
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.odometry.mono.wheel_mode import SeenWay
from fleetmap.sensors.axes import speed_in_words
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import MountedCamera
from fleetmap.sensors.samples import PositionPrior, WheelSample
from locclient.localization.estimate import Estimate

_EXACT_M = 0.1  # maximum sigma of a dock's position prior; three sigmas are the limit of a failure
_LEFT_M = 1.0  # distance travelled until the next report of a dock is a new arrival
_STALE_M = 0.05  # maximum distance travelled between a dock's report and the compared frame


class DockCheck:
    """Compares dock reports with estimates that were already TRACKING; once for each arrival."""

    def __init__(self, base_from_body: Array) -> None:
        self._body_from_base = se3_inverse(base_from_body)
        self._was_tracking = False
        self._last_m: Array | None = None
        self._path_m = np.inf

    def handle(self, priors: Iterable[PositionPrior], estimate: Estimate, odom_from_body: Array) -> float | None:
        """Return the horizontal distance between the estimate of a frame and the dock among its priors.

        None without a dock, if the robot was not TRACKING, and for repeated reports while it stands. odom_from_body (4, 4): in an odometry
        frame that is not redefined once the robot is localized.
        """
        if self._last_m is not None:
            self._path_m += dist(odom_from_body[:3, 3], self._last_m)
        self._last_m = odom_from_body[:3, 3]
        was_tracking, self._was_tracking = self._was_tracking, estimate.status is Status.TRACKING
        exact = [prior for prior in priors if _is_exact(prior) and prior.floor in (None, estimate.floor)]
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


def _is_exact(prior: PositionPrior) -> bool:
    """Return True for a dock's report, not a zone or an operator's estimate."""
    covariance = prior.cov_rot_trans[3:5, 3:5]
    is_known = not prior.is_revisable and np.isfinite(covariance).all()
    return bool(is_known and np.linalg.eigvalsh(covariance)[-1] <= _EXACT_M**2)


_WHEEL_NS = 500_000_000  # maximum age of wheel odometry
_SPAN_NS = 500_000_000  # baseline for a camera's speed: a millimetre of noise is 2 mm/s


class SpeedGauge:
    """Measures the speed of one robot frame by frame."""

    def __init__(self) -> None:
        self._wheel: WheelSample | None = None
        self._from: tuple[int, Array] | None = None
        self._camera_mps: float | None = None

    def handle(self, wheel: Sequence[WheelSample], odometry: OdometryEstimate, odom_from_base: Array) -> float | None:
        """Return metres per second at a frame, by wheels or odometry; None if unknown.

        wheel: since the previous frame. odom_from_base (4, 4): in an odometry frame that is never redefined. Without an IMU the odometry
        estimates no velocity; the speed is then the distance moved within half a second.
        """
        self._wheel = wheel[-1] if wheel else self._wheel
        self._measure(odometry, odom_from_base)
        if self._wheel is not None and abs(odometry.stamp_ns - self._wheel.stamp_ns) <= _WHEEL_NS:
            return hypot(*self._wheel.velocity_base_mps[:2])
        if not odometry.scale_known:
            return None
        return hypot(*odometry.velocity_odom_mps) if odometry.inertial else self._camera_mps

    def _measure(self, odometry: OdometryEstimate, odom_from_base: Array) -> None:
        """Compute distance over time between frames at least _SPAN_NS apart; unknown while the odometry is lost."""
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
_SILENT_NS = 1_000_000_000  # longer than samples of a sound IMU are on their way


def imu_refused(late_s: float | None) -> dict[Flag, str]:
    """Return the flag of a disabled IMU, with its text. late_s: delay of its stamps by the images' rotation, None if not the cause."""
    words = f"it turns otherwise than the images; {_ASK} which axis is wrong"
    if late_s is not None:
        side = "late" if late_s > 0 else "early"
        when = f"its stamps are about {abs(late_s):.2f} s {side} by the turns of the images"
        words = f"{when}; stamp both by one clock, or {_ASK} for the timeshift_cam_imu to set"
    return {Flag.IMU_REFUSED: f"the IMU is left out: {words}"}


def imu_silent(for_ns: int) -> dict[Flag, str]:
    """Return the flag of a calibrated IMU without samples for so long before the images, with its text; empty for less than a second."""
    words = "no samples since more than a second before the images; is it connected, and are both stamped by one clock?"
    return {Flag.IMU_SILENT: f"the IMU is silent: {words}"} if for_ns > _SILENT_NS else {}


def accelerometer_refused(fault: str) -> dict[Flag, str]:
    """Return the flag of an accelerometer with this fault, with its text; empty without a fault."""
    words = f"the accelerometer is left out, the images contradict it: {fault}; mend its driver, or how the calibration mounts it"
    return {Flag.ACCELEROMETER_REFUSED: words} if fault else {}


_LOAD_NS = 5_000_000_000
_OVERLOADED_SHARE = 0.1  # a robot that keeps up drops none; other work that takes half a second costs as much


class Load:
    """Follows how many frames are dropped before they are handled, over the last seconds."""

    def __init__(self) -> None:
        self._recent = deque[tuple[int, int]]()  # stamp of a handled frame, number of those dropped before it
        self.dropped_share = 0.0

    def handle(self, stamp_ns: int, dropped: int) -> None:
        """Add a handled frame. The first seconds, in which a map is loaded, say nothing."""
        self._recent.append((stamp_ns, dropped))
        if stamp_ns - self._recent[0][0] < _LOAD_NS:
            return
        while stamp_ns - self._recent[0][0] > _LOAD_NS:
            self._recent.popleft()
        lost = sum(count for _, count in self._recent)
        self.dropped_share = lost / (lost + len(self._recent))

    @property
    def overload(self) -> dict[Flag, str]:
        """Return the flag of a robot that is too slow for its frames, with its text; empty if it keeps up."""
        words = f"{self.dropped_share:.0%} of the frames are dropped, this computer is too slow for them"
        return {Flag.OVERLOADED: words} if self.dropped_share > _OVERLOADED_SHARE else {}


_OFF_SHARE, _OFF_MPS = 0.5, 0.3  # relative, and absolute for low speeds: slip of a tyre is far less
_LIMIT_M = 3.0  # of contradicting motion: a spinning wheel or a person in front of the camera takes less
_FOLLOWED_SHARE = 0.5  # of the tracks
_SAME_WAY_RAD = np.pi / 4  # between two directions that agree
_REST_SHARE = 0.2  # weight of resting wheels, as the robot may be carried
_DOUBT_M = 1.0  # of contradicting motion, for a sensor that another one supports


class WheelAgreement:
    """Compares wheels and odometry frame by frame.

    is_doubted: rolling wheels contradict the last comparable frame. is_refused: wheels have done so for metres, and have not agreed for as
    long since. ratio: meanwhile, of their speed to that of the images, complex, forward and left.
    """

    def __init__(self, base_from_body: Array) -> None:
        self._base_from_body, self._body_from_base = base_from_body, se3_inverse(base_from_body)
        self._last_ns: int | None = None
        self._rolled = list[WheelSample]()  # since the last way that images have shown
        self._against_m = 0.0
        self._seen_squares, self._products = 0.0, 0j
        self._is_compared = False
        self.is_doubted = self.is_refused = False

    @property
    def ratio(self) -> complex:
        return self._products / self._seen_squares if self._seen_squares else 1.0

    @property
    def refused(self) -> dict[Flag, str]:
        """Return the flag of RobotHealth with its text; empty unless the wheels are refused."""
        if not self.is_refused:
            return {}
        fault = speed_in_words(self.ratio) or "their speed contradicts the images and the IMU"
        return {Flag.WHEELS_REFUSED: f"the wheels are left out: {fault}"}

    def favours(self, turn_rad: float) -> bool | None:
        """Return whether the wheels say that the images' motion is turned by this angle; None if unknown."""
        if self._against_m < _DOUBT_M:
            return False if self._is_compared and not self._against_m else None
        return abs(phase(self.ratio * rect(1.0, -turn_rad))) < _SAME_WAY_RAD

    def handle(self, wheel: Sequence[WheelSample], odometry: OdometryEstimate) -> None:
        """Add a frame; wheel: samples since the previous one."""
        last_ns, self._last_ns = self._last_ns, odometry.stamp_ns
        moved = odometry.previous_from_body
        # Frames too far apart for tracking are no evidence: the odometry itself may be wrong.
        is_followed = odometry.inlier_share >= _FOLLOWED_SHARE and not odometry.after_gap
        is_known = odometry.status is not OdometryStatus.DEGRADED and odometry.scale_known and is_followed
        if last_ns is None or not wheel or not is_known or moved is None:
            self.is_doubted &= not self._is_compared  # in the dark, wheels that agreed before are all that is left
            return
        duration_s = (odometry.stamp_ns - last_ns) * 1e-9
        seen_mps = (self._base_from_body @ moved @ self._body_from_base)[:2, 3] / duration_s
        rolled_mps = sum((sample.velocity_base_mps[:2] for sample in wheel), np.zeros(2)) / len(wheel)
        self._compare(seen_mps, rolled_mps, duration_s)

    def handle_way(self, wheel: Sequence[WheelSample], way: SeenWay | None, base_from_cam: Array) -> None:
        """Add a frame of a robot whose images show the direction of its camera's way alone, which is as long as the wheels say.

        It speaks for all that they rolled since the way before it.
        """
        self._rolled.extend(wheel)
        if way is None:
            return
        samples, self._rolled = self._rolled, self._rolled[-1:]
        turned_m = np.array([-base_from_cam[1, 3], base_from_cam[0, 3]])  # by a turn of one radian
        during = [s.velocity_base_mps[:2] + s.yaw_rate_radps * turned_m for s in samples if s.stamp_ns > way.since_ns]
        if not during:
            return
        rolled_mps = np.mean(during, axis=0)
        seen_mps = way.direction_base[:2] * hypot(*rolled_mps) / max(hypot(*way.direction_base[:2]), 1e-9)
        if seen_mps @ rolled_mps > np.cos(_SAME_WAY_RAD) * (rolled_mps @ rolled_mps):
            seen_mps = rolled_mps
        gaps_s = (min((b.stamp_ns - a.stamp_ns) * 1e-9, 1.0) for a, b in pairwise(samples))
        way_m = sum(hypot(*s.velocity_base_mps[:2]) * gap_s for s, gap_s in zip(samples[1:], gaps_s, strict=True))
        self._compare(seen_mps, rolled_mps, way_m / max(hypot(*rolled_mps), 0.01))

    def _compare(self, seen_mps: Array, rolled_mps: Array, duration_s: float) -> None:
        seen, rolled = length(seen_mps), length(rolled_mps)
        step_m = min(max(seen, min(rolled, 1.0)), 10.0) * duration_s
        if length(rolled_mps - seen_mps) > max(_OFF_MPS, _OFF_SHARE * min(seen, rolled)):
            self._against_m += step_m * (_REST_SHARE if rolled < 0.01 else 1.0)
            self._products += complex(*rolled_mps) * complex(*seen_mps).conjugate()
            self._seen_squares += seen**2
            self.is_doubted = rolled >= 0.01
        else:
            self._against_m -= step_m
            self.is_doubted = False
            self._is_compared |= seen > _OFF_MPS
        self._against_m = min(max(self._against_m, 0.0), 2.0 * _LIMIT_M)
        if self._against_m >= _LIMIT_M:
            self.is_refused = True
        elif self._against_m == 0.0:
            self.is_refused, self._seen_squares, self._products = False, 0.0, 0j


class ExchangedViews:
    """Compares the images with all other sensors at once: what one rotation of the images explains for each is a fault of the images.

    Rotations are those of other cameras against the first one, whose topics may be exchanged, and that of the wheels against the images.
    """

    def __init__(self, calibration: RigCalibration, mounted: Sequence[MountedCamera]) -> None:
        """mounted: the cameras of the rig."""
        self._base_from_body = calibration.base_from_body[:3, :3]
        first, *names = (" and ".join(f"cam{number}" for number in numbers) for numbers in calibration.views)
        axes = [self._base_from_body @ each.body_from_cam[:3, :3] for each in mounted]
        self._turns_rad = {
            f"the topics of {first} are exchanged with those of {name}, or ": float(so3_log(other @ axes[0].T)[2])
            for name, other in zip(names, axes[1:], strict=True)
        }

    def refused(self, wheels: WheelAgreement, accelerometer: AccelerometerCheck) -> dict[Flag, str]:
        """Return the flag of images that all other sensors contradict, with its text; empty without evidence."""
        for exchange, turn_rad in {**self._turns_rad, "": phase(wheels.ratio)}.items():
            if abs(turn_rad) <= _SAME_WAY_RAD:
                continue
            seen_from_true = self._base_from_body.T @ so3_exp(np.array([0.0, 0.0, -turn_rad])) @ self._base_from_body
            by = {"wheels": wheels.favours(turn_rad), "accelerometer": accelerometer.favours(seen_from_true)}
            against = [sensor for sensor, favours in by.items() if favours]
            if False not in by.values() and len(against) > (0 if exchange else 1):
                words = f"they move turned by {abs(np.degrees(turn_rad)):.0f} degrees against {' and '.join(against)}"
                mounted = "the cameras" if len(against) > 1 else f"the cameras or the {against[0]}"
                cause = f"{exchange}{mounted} are mounted otherwise than calibrated"
                return {Flag.IMAGES_REFUSED: f"the images are left out: {words}: {cause}"}
        return {}
