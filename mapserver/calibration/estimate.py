"""Calibration estimated from recordings: every parameter with its sigma, and whether it is accurate enough to be used."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.geometry import Array
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from mapserver.calibration.estimator import Adjusted, adjust, prior_information
from mapserver.calibration.motion_rows import CalibrationData
from mapserver.calibration.parameters import COLUMNS, INDEX, CalibrationParameter, RigAxes, corrected_rig

P = CalibrationParameter
_PAIR = {P.BASELINE, P.FOCAL_RATIO, P.PAIR_PITCH, P.PAIR_YAW, P.PAIR_ROLL, P.BASELINE_Y, P.BASELINE_Z}
_INERTIAL = {P.CAMERA_IMU_X, P.CAMERA_IMU_Y, P.CAMERA_IMU_Z, P.TIME_OFFSET, P.GYRO_NOISE, P.ACCEL_NOISE}
_LARGEST_PRIOR_SHARE = 0.5  # of the prior's sigma: above, the estimate only repeats the prior
_ROUNDED = 0.1  # of `least_sigma`
MIN_KEYFRAMES = 20  # neighbouring keyframes have common errors: a few of them can agree on a wrong calibration
_ADVICE = dict.fromkeys(P, "drive turns")
_ADVICE[P.BASELINE] = "the accelerometer is hardly excited: start, stop and turn more often, or record wheel odometry"
_ADVICE |= dict.fromkeys((P.CAMERA_IMU_X, P.CAMERA_IMU_Y, P.CAMERA_IMU_Z), "turn to both sides, and start and stop")
_ADVICE |= {P.TIME_OFFSET: "begin and end turns briskly"}
_ADVICE |= {P.CAMERA_POSITION_X: "turn to both sides", P.CAMERA_POSITION_Y: "turn to both sides"}
_ADVICE |= {P.CAMERA_POSITION_Z: "unobservable on a level floor: tilt it over a ramp, or measure by hand"}
_ADVICE |= {P.WHEEL_SCALE: "the wheels' own error and the baseline's look alike: start, stop and turn more often"}
_ADVICE |= dict.fromkeys((P.GYRO_NOISE, P.ACCEL_NOISE), "record for longer")


@dataclass(frozen=True, slots=True)
class ParameterEstimate:
    """Correction of one parameter: estimate 0 if the calibration is right.

    sigma: the prior's if the parameter is unobservable. is_judged: accurate enough to be used. reason: the motion or sensor
    that would make it observable, empty if it is judged.
    """

    name: CalibrationParameter
    estimate: float
    sigma: float
    is_judged: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class CalibrationEstimate:
    """All parameters, and the covariance (C, C) of the first C of them, which are columns of the adjustment.

    keyframes, observations: their numbers.
    """

    parameters: tuple[ParameterEstimate, ...]
    covariance: Array
    keyframes: int
    observations: int

    def get(self, name: CalibrationParameter) -> ParameterEstimate:
        """The estimate of one parameter."""
        return next(p for p in self.parameters if p.name is name)

    def corrections(self) -> Array:
        """Return (C,) corrections of the judged parameters; the rest of the rig keeps its values, corrections zero.

        In steps of a tenth of the error that no adjustment sees: images rectified anew are then the same ones after a change of the
        last digits, which new tracks would blow up to more than a sigma.
        The wheels are not part of the rig: the uncertainty of their error is unchanged.
        """
        theta = np.array([p.estimate for p in self.parameters[: len(COLUMNS)]])
        judged = np.array([p.is_judged for p in self.parameters[: len(COLUMNS)]])
        kept = ~judged
        kept[INDEX[P.WHEEL_SCALE]] = False
        if kept.any() and judged.any():
            across = self.covariance[np.ix_(judged, kept)]
            theta[judged] -= across @ np.linalg.solve(self.covariance[np.ix_(kept, kept)], theta[kept])
        theta[kept] = 0.0
        theta[INDEX[P.WHEEL_SCALE]] = 0.0
        steps = np.array([_ROUNDED * p.least_sigma for p in COLUMNS])
        return np.asarray(steps * np.round(theta / steps))

    def corrected(self, rig: RigCalibration) -> RigCalibration:
        """Return `rig`, which must be that of the recordings, with all judged parameters of its first view corrected."""
        return corrected_rig(rig, RigAxes.of(rig, Rectifier(rig)), self.corrections())


def continued_from(before: Array, found: CalibrationEstimate) -> CalibrationEstimate:
    """Convert an estimate relative to a rig corrected by `before` (C,) into one relative to the uncorrected rig."""
    if not before.any():
        return found
    parameters = []
    for p in found.parameters:
        earlier = float(before[INDEX[p.name]]) if p.name in INDEX else 0.0
        is_share = not p.name.unit
        total = (1.0 + earlier) * (1.0 + p.estimate) - 1.0 if is_share else earlier + p.estimate
        parameters.append(replace(p, estimate=total))
    return replace(found, parameters=tuple(parameters))


def estimate_from(stretches: Sequence[CalibrationData]) -> CalibrationEstimate:
    """Return the estimate from stretches of drives with one rig together: by the sum of their information; the prior counts once."""
    adjusted = [adjust(data) for data in stretches]
    information = np.diag(prior_information())
    pull = np.zeros(len(COLUMNS))
    for each in adjusted:
        information += each.information - np.diag(prior_information())
        pull += each.information @ each.theta
    covariance: Array = np.asarray(np.linalg.inv(information), np.float64)
    theta = covariance @ pull
    covariance += np.diag(_common_errors(stretches) ** 2)
    first = stretches[0]
    if not first.is_inertial:  # with a gyro the focal length is observable for any lens; by depths alone it is not
        covariance[INDEX[P.FOCAL], INDEX[P.FOCAL]] += max(each.focal_by_lens for each in adjusted) ** 2
    keyframes = sum(len(data.stamps_ns) for data in stretches)
    has_wheels = any(len(data.wheel) > 0 for data in stretches)
    has_pair, has_imu = len(first.calibration.cameras) > 1, first.is_inertial
    sigmas = np.sqrt(np.diag(covariance))
    values = [(p, float(theta[INDEX[p]]), float(sigmas[INDEX[p]])) for p in COLUMNS]
    if first.calibration.imu is not None:
        values += [(name, scale - 1.0, sigma) for name, scale, sigma in _noise(adjusted)]
    found = [
        _judged(*value, keyframes, _reason(value[0], has_pair=has_pair, has_imu=has_imu, has_wheels=has_wheels))
        for value in values
    ]
    return CalibrationEstimate(tuple(found), covariance, keyframes, sum(each.observations for each in adjusted))


def _common_errors(stretches: Sequence[CalibrationData]) -> Array:
    """Return (C,) shifts of the parameters by an error common to all pixels or disparities: an angle, a share, a lever."""
    camera, bias_px = stretches[0].rectifier.camera, stretches[0].bias_px
    disparities = np.concatenate([each.obs_pixels[:, 0] - each.obs_pixels[:, 2] for each in stretches])
    known = disparities[np.isfinite(disparities)]
    disparity_px = max(float(np.median(known)), 1.0) if len(known) else 1.0
    half, beside = 0.5 * camera.width_px, 0.25 * camera.width_px / camera.focal_px
    sizes = {
        P.BASELINE: bias_px / disparity_px,
        P.FOCAL: bias_px / (0.5 * half),
        P.FOCAL_RATIO: bias_px / half,
        P.PRINCIPAL_X: bias_px / beside**2,
        P.PRINCIPAL_Y: bias_px / beside**2,
        P.CAMERA_IMU_X: bias_px / beside**2 / camera.focal_px,
        P.CAMERA_IMU_Y: bias_px / beside**2 / camera.focal_px,
        P.PAIR_PITCH: bias_px / camera.focal_px,
        P.PAIR_YAW: bias_px / camera.focal_px,
        P.PAIR_ROLL: bias_px / half,
        P.BASELINE_Y: bias_px / disparity_px,
        P.BASELINE_Z: bias_px / (disparity_px * beside),
    }
    return np.array([sizes.get(p, 0.0) for p in COLUMNS])


def _noise(adjusted: Sequence[Adjusted]) -> list[tuple[CalibrationParameter, float, float]]:
    """Name, scale and sigma of the IMU's noise: means weighted by their redundancy."""
    found = []
    for name, pairs in (
        (P.GYRO_NOISE, [(a.scales.gyro, a.gyro_sigma) for a in adjusted]),
        (P.ACCEL_NOISE, [(a.scales.accel, a.accel_sigma) for a in adjusted]),
    ):
        weights = np.array([sigma**-2.0 for _, sigma in pairs])
        total = float(weights.sum())
        if total > 0:
            scale = float(weights @ [value for value, _ in pairs]) / total
            found.append((name, scale, scale * total**-0.5))
        else:
            found.append((name, 1.0, name.prior_sigma))
    return found


def _judged(
    name: CalibrationParameter, estimate: float, sigma: float, keyframes: int, reason: str
) -> ParameterEstimate:
    """reason: the motion or sensor needed if the estimate is not accurate."""
    is_long = keyframes >= MIN_KEYFRAMES
    is_sharp = sigma <= min(name.useful_sigma, _LARGEST_PRIOR_SHARE * name.prior_sigma)
    short = f"too short: {keyframes} keyframes, {MIN_KEYFRAMES} are needed"
    lacking = [*([] if is_long else [short]), *([] if is_sharp else [reason])]
    return ParameterEstimate(name, estimate, sigma, not lacking, "; ".join(lacking))


def _reason(name: CalibrationParameter, *, has_pair: bool, has_imu: bool, has_wheels: bool) -> str:
    has_metres = has_imu or has_wheels
    lacks = {
        "there is one camera": name in _PAIR and not has_pair,
        "there is no IMU": name in _INERTIAL and not has_imu,
        "there is no wheel odometry": name is P.WHEEL_SCALE and not has_wheels,
        "without the turns of an IMU an error of the lens looks the same: record one": name is P.FOCAL and not has_imu,
        "neither an IMU nor wheels measure metres: record one of them": name is P.BASELINE and not has_metres,
        "there is neither an IMU nor wheel odometry": name.startswith("camera position") and not has_metres,
    }
    return next((words for words, is_lacking in lacks.items() if is_lacking), _ADVICE[name])
