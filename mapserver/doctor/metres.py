"""Who is right about metres: the images by their baseline or depths, the accelerometer by gravity, the wheels by their radius.

Two that agree contradict the third. Wheels also have a direction and a yaw rate, which no baseline explains.
"""

from dataclasses import dataclass

import numpy as np

from mapserver.doctor.accelerometer_images import AxesFit
from mapserver.doctor.findings import Finding, Verdict, not_judged
from mapserver.doctor.wheel_images import WheelFit

WHEELS, METRES = "wheels", "metric scale"
_RESTS_MPS = 0.05  # images of a camera at rest show less, by their noise
_OFF = 1.3  # a ratio beyond this contradicts; what is nearer to 1 is measured with the calibration
_SURE_SIGMAS = 3.0
_KNOWN_SHARE = 0.2  # a ratio that is not known to a fifth decides nothing
_UNITS = {1000.0: "mm/s", 100.0: "cm/s", 3.6: "km/h", 2.237: "miles per hour"}
# What no robot has: cameras that far apart (m), a median depth (m), a speed of cameras and of wheels (m/s)
_BASELINES_M, _DEPTHS_M, _FASTEST_MPS, _FASTEST_WHEELS_MPS = (0.005, 3.0), (0.05, 500.0), 70.0, 25.0
_LEFT_OUT = "the wheels are left out"
_LIMIT = f"fail where a ratio is beyond {_OFF:g} for sure, or its sign is wrong"


@dataclass(frozen=True, slots=True)
class ImageMetres:
    """What the images' metres rest on. baseline_m: of a pair, None for depth images; the median depth that is seen with it."""

    baseline_m: float | None
    depth_m: float

    @property
    def source(self) -> str:
        """In words."""
        return "the unit of the depth images" if self.baseline_m is None else f"the baseline of {self.baseline_m:.4g} m"

    def implausible(self, speed_mps: float) -> str:
        """Which of them, and of the speed that they show, no robot has; empty if all may be."""
        checks = [
            ("a baseline", self.baseline_m, _BASELINES_M, "m"),
            ("a median depth", self.depth_m, _DEPTHS_M, "m"),
            ("a speed", speed_mps, (0.0, _FASTEST_MPS), "m/s"),
        ]
        odd = [
            f"{what} of {v:.4g} {unit}"
            for what, v, (low, high), unit in checks
            if v is not None and (v < low or v > high)
        ]
        return " and ".join(odd)


@dataclass(frozen=True, slots=True)
class Metres:
    """What is known: the wheels, None without any; true metres in one of the images by gravity, with sigma, None if unknown; the images."""

    wheels: WheelFit | None
    by_gravity: tuple[float, float] | None
    images: ImageMetres | None
    image_mps: float

    @classmethod
    def of(
        cls, wheels: WheelFit | None, given: AxesFit | None, images: ImageMetres | None, image_mps: float
    ) -> "Metres":
        """given: the accelerometer's axes as given, None where those may be wrong. image_mps: a typical speed by the images."""
        is_known = given is not None and given.sigma < _KNOWN_SHARE * abs(given.metres)
        return cls(wheels, (given.metres, given.sigma) if given is not None and is_known else None, images, image_mps)

    def wheels_finding(self) -> Finding:
        """Whether the wheels drive as the images move; a failure says that they are left out."""
        fit = self.wheels
        if fit is None:
            return not_judged(WHEELS, "nothing to compare", "there is no wheel odometry")
        fault = self._wheel_fault(fit)
        if fault:
            value = None if fit.speed is None else float(np.copysign(abs(fit.speed), fit.speed.real))
            return Finding(WHEELS, Verdict.FAIL, value, _LIMIT, f"{fault}; {_LEFT_OUT}")
        if fit.speed is None and fit.yaw is None:
            return not_judged(WHEELS, "nothing moves, or one camera shows no metres", "drive, and record a pair")
        return Finding(
            WHEELS,
            Verdict.OK,
            None if fit.speed is None else abs(fit.speed),
            _LIMIT,
            "the wheels drive as the images move",
        )

    def metres_finding(self) -> Finding:
        """Whether a metre of the images may be one."""
        images, fit = self.images, self.wheels
        if images is None:
            return not_judged(METRES, "one camera shows no metres", "record a pair or depth")
        odd = images.implausible(self.image_mps)
        ratio = None if fit is None else _size(fit)
        by_wheels = "" if ratio is None else f"{ratio:.3g} m by the wheels"
        by_gravity = "" if self.by_gravity is None else f"{self.by_gravity[0]:.3g} m by the accelerometer"
        measured = f"a metre of the images is {' and '.join(each for each in (by_wheels, by_gravity) if each)}"
        advice = f"check {images.source}"
        is_off = (
            self.by_gravity is not None
            and _is_off(*self.by_gravity)
            and (ratio is None or fit is None or _is_off(ratio, fit.speed_sigma))
        )
        if self._disagree and fit is not None:
            measured = f"the wheels drive at {fit.wheel_mps:.2g} m/s where the images move at {fit.image_mps:.2g} m/s, in no steady ratio"
        if self._blamed() in ("images", "either") or (is_off and self._blamed() != WHEELS):
            if self._blamed() == "either":
                advice += " and the wheels' unit and radius: nothing tells which of them is wrong"
            return Finding(
                METRES, Verdict.FAIL, ratio or (self.by_gravity or (None,))[0], _LIMIT, f"{measured}; {advice}"
            )
        if odd:
            return Finding(
                METRES, Verdict.FAIL, None, "fail for what no robot has", f"by {images.source} there is {odd}; {advice}"
            )
        if by_wheels or by_gravity:
            return Finding(METRES, Verdict.OK, ratio or (self.by_gravity or (None,))[0], _LIMIT, measured)
        shown = f"nothing but {images.source} tells metres: by it things are {images.depth_m:.2g} m away in the median"
        shown += f" and the cameras move at {self.image_mps:.2g} m/s" if self.image_mps else ""
        return not_judged(METRES, shown, "record an IMU, with starts, stops and turns, or wheel odometry")

    @property
    def _disagree(self) -> bool:
        """True for images that move by their own metres, but in no ratio to the wheels, as with depths ten times too small."""
        fit = self.wheels
        is_unknown = fit is not None and fit.speed is not None and not np.isfinite(fit.speed)
        return fit is not None and is_unknown and fit.image_mps > _RESTS_MPS

    def _wheel_fault(self, fit: WheelFit) -> str:
        speed = fit.speed
        if speed is not None:
            if not np.isfinite(speed) and not self._disagree:
                return f"the wheels drive at {fit.wheel_mps:.2g} m/s while the images rest: see whether the pictures change"
            if self._disagree:
                return ""
            if abs(speed) < 0.01 and fit.wheel_mps < 0.01 * fit.image_mps:
                return f"the wheels rest while the images move at {fit.image_mps:.2g} m/s: see whether odometry is published"
            angle_deg = float(np.degrees(np.angle(speed)))
            if abs(angle_deg) > 135.0:
                return "the wheels drive backwards while the images move forwards: negate their speed, or mend base_from_body"
            if abs(angle_deg) > 45.0:
                return f"the wheels drive {angle_deg:+.0f} degrees away from where the images move: mend base_from_body"
            if self._blamed() == WHEELS:
                unit = next(
                    (
                        f": they are in {unit}"
                        for factor, unit in _UNITS.items()
                        if abs(abs(speed) / factor - 1.0) < 0.1
                    ),
                    "",
                )
                return f"the wheels drive {abs(speed):.3g} times as fast as the images move{unit}; check their unit and radius"
        if fit.yaw is not None:
            if not np.isfinite(fit.yaw):
                return "the wheels turn while the images do not"
            if abs(np.degrees(1.0) / fit.yaw - 1.0) < 0.2:
                return "the wheels' yaw rate is in degrees per second: multiply it by pi/180"
            if not 1.0 / (2.0 * _OFF) < fit.yaw < 2.0 * _OFF:
                return f"the wheels' yaw rate is {fit.yaw:.2g} times that of the images: check its sign and unit"
        return ""

    def _blamed(self) -> str:
        """Which of wheels and images is wrong about metres: `either` where nothing tells, empty where they agree or one is not known."""
        fit = self.wheels
        if self._disagree:
            return "either"
        ratio = None if fit is None else _size(fit)
        if fit is None or ratio is None or not _is_off(ratio, fit.speed_sigma):
            return ""
        if self.by_gravity is not None and self.by_gravity[0] > 0:
            gravity = np.log(self.by_gravity[0])
            return WHEELS if abs(gravity) < abs(gravity - np.log(ratio)) else "images"
        if self.images is not None and self.images.implausible(self.image_mps):
            return "images"
        return WHEELS if fit.wheel_mps > _FASTEST_WHEELS_MPS else "either"


def _size(fit: WheelFit) -> float | None:
    """Wheels over images where both drive in about one direction."""
    speed = fit.speed
    if speed is None or not np.isfinite(speed) or speed.real <= abs(speed.imag) or abs(speed) < 1e-6:
        return None
    return abs(speed)


def _is_off(ratio: float, sigma: float) -> bool:
    return ratio <= 0 or abs(np.log(ratio)) - _SURE_SIGMAS * sigma / ratio > np.log(_OFF)
