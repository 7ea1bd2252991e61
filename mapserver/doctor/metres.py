"""Metric scale compared: images (baseline or depths), accelerometer (gravity), wheels (radius).

Two that agree contradict the third. Wheels also have a direction and a yaw rate, which no error of the baseline explains.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.sensors.axes import speed_in_words
from fleetmap.sensors.samples import WheelSample
from mapserver.doctor.accelerometer_images import AxesFit
from mapserver.doctor.camera_motion import CameraTurns
from mapserver.doctor.findings import Finding, Verdict, not_judged

WHEELS, METRES = "wheels", "metric scale"
_RESTS_MPS = 0.05  # the noise of images at rest is below
_OFF = 1.3  # a ratio beyond contradicts; smaller errors are measured with the calibration
_SURE_SIGMAS = 3.0
_KNOWN_SHARE = 0.2  # a ratio with a larger sigma decides nothing
# Implausible for any robot: distance of cameras (m), median depth (m), speed of cameras and of wheels (m/s)
_BASELINES_M, _DEPTHS_M, _FASTEST_MPS, _FASTEST_WHEELS_MPS = (0.005, 3.0), (0.05, 500.0), 70.0, 25.0
_LIMIT = f"fail if a ratio is certainly beyond {_OFF:g}, or its sign is wrong"


@dataclass(frozen=True, slots=True)
class WheelFit:
    """Wheels over images: medians, robust to a minority of slips and of people in the pictures.

    speed: complex, forward and left: -1 for wheels that count backwards, 1j for a base rotated by 90 degrees. yaw: of the rates.
    Both 0 for wheels at rest with moving images, infinite for images at rest, None with too little motion. speed_sigma: of its magnitude.
    image_mps, wheel_mps: median speeds while one of them moves.
    """

    speed: complex | None
    speed_sigma: float
    yaw: float | None
    image_mps: float
    wheel_mps: float

    @property
    def size(self) -> float | None:
        """Wheels over images if both drive in about one direction."""
        speed = self.speed
        if speed is None or not np.isfinite(speed) or speed.real <= abs(speed.imag) or abs(speed) < 1e-6:
            return None
        return abs(speed)

    @property
    def is_unsteady(self) -> bool:
        """True if the images move but in no constant ratio to the wheels, as with depths ten times too small."""
        return self.speed is not None and not np.isfinite(self.speed) and self.image_mps > _RESTS_MPS


@dataclass(frozen=True, slots=True)
class ImageMetres:
    """Source of the images' scale. baseline_m: of a pair, None for depth images; the resulting median depth and speed."""

    baseline_m: float | None
    depth_m: float
    speed_mps: float

    @property
    def source(self) -> str:
        """The source as text."""
        return "the unit of the depth images" if self.baseline_m is None else f"the baseline of {self.baseline_m:.4g} m"

    @property
    def implausible(self) -> str:
        """The implausible value; empty if all are plausible."""
        checks = [
            ("a baseline", self.baseline_m, _BASELINES_M, "m"),
            ("a median depth", self.depth_m, _DEPTHS_M, "m"),
            ("a speed", self.speed_mps, (0.0, _FASTEST_MPS), "m/s"),
        ]
        return " and ".join(
            f"{what} of {value:.4g} {unit}"
            for what, value, (low, high), unit in checks
            if value is not None and not low <= value <= high
        )


def judge_metres(
    wheels: WheelFit | None, given: AxesFit | None, images: ImageMetres | None, *, has_imu: bool
) -> tuple[Finding, Finding]:
    """Judge the wheels' motion against the images' (on failure they are left out), and the scale of the images.

    given: fit with the given accelerometer axes, None if those may be wrong; images: None for one camera.
    """
    by_gravity = given if given is not None and given.sigma < _KNOWN_SHARE * abs(given.metres) else None
    blamed = _blamed(wheels, by_gravity, images)
    return _wheels_finding(wheels, blamed), _metres_finding(wheels, by_gravity, images, blamed, has_imu=has_imu)


def _blamed(fit: WheelFit | None, by_gravity: AxesFit | None, images: ImageMetres | None) -> str:
    """Return the wrong one of wheels and images: `either` if undecided, empty if they agree or one is unknown."""
    if fit is None:
        return ""
    if fit.is_unsteady:
        return "either"
    if fit.size is None or not _is_off(fit.size, fit.speed_sigma):
        return ""
    if by_gravity is not None and by_gravity.metres > 0:
        gravity = np.log(by_gravity.metres)
        return WHEELS if abs(gravity) < abs(gravity - np.log(fit.size)) else "images"
    if images is not None and images.implausible:
        return "images"
    return WHEELS if fit.wheel_mps > _FASTEST_WHEELS_MPS else "either"


def _is_off(ratio: float, sigma: float) -> bool:
    return ratio <= 0 or abs(np.log(ratio)) - _SURE_SIGMAS * sigma / ratio > np.log(_OFF)


def _wheels_finding(fit: WheelFit | None, blamed: str) -> Finding:
    if fit is None:
        return not_judged(WHEELS, "nothing to compare", "there is no wheel odometry")
    fault = _speed_fault(fit, blamed) or ("" if fit.is_unsteady else _yaw_fault(fit))
    if fault:
        value = None if fit.speed is None else float(np.copysign(abs(fit.speed), fit.speed.real))
        return Finding(WHEELS, Verdict.FAIL, value, _LIMIT, f"{fault}; the wheels are left out")
    if fit.speed is None and fit.yaw is None:
        return not_judged(WHEELS, "nothing moves, or one camera shows no metres", "drive, and record a pair")
    value = None if fit.speed is None else abs(fit.speed)
    return Finding(WHEELS, Verdict.OK, value, _LIMIT, "wheels and images move alike")


def _speed_fault(fit: WheelFit, blamed: str) -> str:
    speed = fit.speed
    if speed is None or fit.is_unsteady:
        return ""
    if not np.isfinite(speed):
        return f"the wheels drive at {fit.wheel_mps:.2g} m/s while the images rest: check that the pictures change"
    if abs(speed) < 0.01 and fit.wheel_mps < 0.01 * fit.image_mps:
        return f"the wheels rest while the images move at {fit.image_mps:.2g} m/s: check that odometry is published"
    return speed_in_words(speed, has_wrong_size=blamed == WHEELS)


def _yaw_fault(fit: WheelFit) -> str:
    if fit.yaw is None:
        return ""
    if not np.isfinite(fit.yaw):
        return "the wheels turn while the images do not"
    if abs(np.degrees(1.0) / fit.yaw - 1.0) < 0.2:
        return "the wheels' yaw rate is in degrees per second: multiply it by pi/180"
    if not 1.0 / (2.0 * _OFF) < fit.yaw < 2.0 * _OFF:
        return f"the wheels' yaw rate is {fit.yaw:.2g} times that of the images: check its sign and unit"
    return ""


def _metres_finding(
    fit: WheelFit | None, by_gravity: AxesFit | None, images: ImageMetres | None, blamed: str, *, has_imu: bool
) -> Finding:
    if images is None:
        return not_judged(METRES, "one camera shows no metres", "record a pair or depth")
    ratio = None if fit is None else fit.size
    value = ratio or (None if by_gravity is None else by_gravity.metres)
    said = [] if ratio is None else [f"{ratio:.3g} m by the wheels"]
    said += [] if by_gravity is None else [f"{by_gravity.metres:.3g} m by the accelerometer"]
    measured = f"a metre of the images is {' and '.join(said)}"
    advice = f"check {images.source}"
    if fit is not None and fit.is_unsteady:
        measured = f"the wheels drive at {fit.wheel_mps:.2g} m/s where the images move at {fit.image_mps:.2g} m/s, in no steady ratio"
    is_off = by_gravity is not None and _is_off(by_gravity.metres, by_gravity.sigma)
    if fit is not None and ratio is not None:
        is_off = is_off and _is_off(ratio, fit.speed_sigma)
    if blamed in ("images", "either") or (is_off and blamed != WHEELS):
        if blamed == "either":
            advice += " and the wheels' unit and radius: the data do not show which is wrong"
        return Finding(METRES, Verdict.FAIL, value, _LIMIT, f"{measured}; {advice}")
    if odd := images.implausible:
        words = f"by {images.source} there is {odd}; {advice}"
        return Finding(METRES, Verdict.FAIL, None, "fail for implausible values", words)
    if said:
        return Finding(METRES, Verdict.OK, value, _LIMIT, measured)
    shown = f"only {images.source} gives the scale: with it objects are {images.depth_m:.2g} m away in the median"
    shown += f" and the cameras move at {images.speed_mps:.2g} m/s" if images.speed_mps else ""
    missing = "record an IMU, with starts, stops and turns, or wheel odometry"
    if has_imu:
        missing = "start, stop and turn more often, so that the IMU gives the scale, or record wheel odometry"
    return not_judged(METRES, shown, missing)


_LEAST_MPS, _LEAST_RADPS = 0.1, 0.1  # below, a robot counts as at rest
_MIN_MOVING = 5
_SAMPLES = 5  # of an interval
_STEADY_SIGMAS = 5.0


def fit_wheels(
    turns: CameraTurns, wheel: Sequence[WheelSample], base_from_body: Array, imu_minus_cam_s: float
) -> WheelFit:
    """Fit the wheels to the images' motion in the same intervals; wheels are on the IMU's clock."""
    seen, rolled = list[Array](), list[Array]()
    stamps_s = (np.array([sample.stamp_ns for sample in wheel], np.int64) - wheel[0].stamp_ns) * 1e-9
    columns = np.array([[*sample.velocity_base_mps[:2], sample.yaw_rate_radps] for sample in wheel]).T
    spans_s = (np.stack([turns.starts_ns, turns.ends_ns], axis=1) - wheel[0].stamp_ns) * 1e-9 + imu_minus_cam_s
    for (start_s, end_s), rate, way_m in zip(spans_s, turns.rates_body_radps, turns.ways_m, strict=True):
        if start_s < stamps_s[0] or end_s > stamps_s[-1]:
            continue
        turn = rate * (end_s - start_s)
        base = base_from_body @ se3(so3_exp(turn), way_m) @ se3_inverse(base_from_body)
        turn_base = base_from_body[:3, :3] @ turn
        way_base = so3_exp(-0.5 * turn_base) @ base[:3, 3]
        seen.append(np.array([way_base[0], way_base[1], turn_base[2]]) / (end_s - start_s))
        times = np.linspace(start_s, end_s, _SAMPLES)
        rolled.append(np.array([np.interp(times, stamps_s, column).mean() for column in columns]))
    by_images, by_wheels = (np.array(each).reshape(-1, 3) for each in (seen, rolled))
    image_speeds, wheel_speeds = (each[:, 0] + 1j * each[:, 1] for each in (by_images, by_wheels))
    moving = np.fmax(np.abs(image_speeds), np.abs(wheel_speeds)) > _LEAST_MPS
    sizes = np.abs(np.stack([image_speeds, wheel_speeds]))[:, moving]
    image_mps, wheel_mps = np.median(sizes, axis=1).tolist() if moving.any() else (0.0, 0.0)
    speed, sigma = _ratio(image_speeds, wheel_speeds, _LEAST_MPS)
    yaw, _ = _ratio(by_images[:, 2], by_wheels[:, 2], _LEAST_RADPS)
    return WheelFit(speed, sigma, None if yaw is None else yaw.real, image_mps, wheel_mps)


def _ratio(seen: Array, rolled: Array, least: float) -> tuple[complex | None, float]:
    """Return wheels over images, and the sigma of its magnitude: while the wheels move, or else while the images do."""
    known = np.isfinite(seen)
    drives, moves = known & (np.abs(rolled) > least), known & (np.abs(seen) > least)
    if drives.sum() >= _MIN_MOVING:
        shares = seen[drives] / rolled[drives]
        median = complex(np.median(shares.real), np.median(shares.imag))
        sigma = 1.25 * 1.4826 * float(np.median(np.abs(shares - median))) / float(np.sqrt(len(shares)))
        if abs(median) <= _STEADY_SIGMAS * sigma:
            return complex(np.inf), np.inf
        return 1.0 / median, sigma / abs(median) ** 2
    if moves.sum() >= _MIN_MOVING:
        return complex(np.median((rolled[moves] / seen[moves]).real)), 0.0
    return None, np.inf
