"""Findings about the calibration: the result of a self-calibrating adjustment, against the effect of each error.

A limit is the error that displaces something by 3 cm: a map of 20 m seen from its middle (its scale), a point at 3 m (bearings), or at 25
baselines (depths), a robot at 2 m/s (clocks). Beyond the second limit the file describes another rig. To an estimate's own sigma are added
errors outside the adjustment: remaining lens distortion, bias of sub-pixel matching, a gyro's scale.
"""

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fleetmap.errors import RecordingError, SurveyError
from fleetmap.geometry import Array
from fleetmap.recordings import Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from mapserver.calibration import CalibrationEstimate, CalibrationParameter, ParameterEstimate, estimate_calibration
from mapserver.calibration.motion_rows import CalibrationData
from mapserver.calibration.parameters import COLUMNS, SHOWN
from mapserver.calibration.recordings import Follow, busiest_frames
from mapserver.doctor.findings import Finding, Verdict, not_judged
from mapserver.doctor.sensors import SPARSE_S, median_period_s

P = CalibrationParameter
SURE_SIGMAS = 3.0
_LONGER = "record a longer drive, with turns, starts and stops"


# Those that a build does not correct: a drive shows them worse than a ruler, or they belong to no camera.
_KEPT = {P.CAMERA_POSITION_X, P.CAMERA_POSITION_Y, P.CAMERA_POSITION_Z, P.WHEEL_SCALE, P.GYRO_NOISE, P.ACCEL_NOISE}
# Directions in which a shift of the principal point resembles a rotation against the IMU.
_SAME_BEARING = {P.CAMERA_IMU_X: (P.PRINCIPAL_Y, 1.0), P.CAMERA_IMU_Y: (P.PRINCIPAL_X, -1.0)}


@dataclass(frozen=True, slots=True)
class MeasuredCalibration:
    """Findings of all parameters, and their estimate; None if nothing could be estimated."""

    findings: list[Finding]
    estimate: CalibrationEstimate | None

    def wrong(self) -> list[CalibrationParameter]:
        """Parameters whose error certainly exceeds its tolerance and is known accurately: those a build may correct."""
        bad = {f.name for f in self.findings if f.verdict is Verdict.WARN and not f.missing}
        return [p for p in P if p.value in bad and p not in _KEPT]


def followed_frames(recording: Recording) -> int:
    """Return the number of frames read by `measure_calibration`; 0 if it judges nothing."""
    is_judged = len(recording.calibration.cameras) > 1 and median_period_s(recording.frame_stamps_ns) <= SPARSE_S
    return len(busiest_frames(recording.frame_stamps_ns, recording.imu)) if is_judged else 0


def measure_calibration(
    recording: Recording, follow: Follow, first: CalibrationData | None = None
) -> MeasuredCalibration:
    """Measure every parameter of the calibration of a recording with a camera pair. first: as in `estimate_calibration`.

    If nothing is wrong the calibration is not refined further: it would be used unchanged.
    """
    period_s = median_period_s(recording.frame_stamps_ns)
    if period_s > SPARSE_S:
        return unknown_calibration(f"frames are {period_s:.2f} s apart", "record every frame of the camera")
    try:
        focal_px = Rectifier(recording.calibration).camera.focal_px
        estimate = estimate_calibration([recording], follow, partial(_is_good, focal_px), first)
    except (RecordingError, SurveyError, np.linalg.LinAlgError) as error:
        return unknown_calibration(
            f"the frames could not be tracked: {error}", "record a drive in the light, with every frame"
        )
    return MeasuredCalibration(findings_of(estimate, focal_px), estimate)


def _is_good(focal_px: float, estimate: CalibrationEstimate, moved: Sequence[CalibrationParameter]) -> bool:
    """True if nothing is wrong, and parameters far from the start are certainly accurate enough."""
    bad, found = (Verdict.WARN, Verdict.FAIL), findings_of(estimate, focal_px)
    return all(f.verdict is Verdict.OK if f.name in moved else f.verdict not in bad for f in found)


def findings_of(estimate: CalibrationEstimate, focal_px: float) -> list[Finding]:
    """Return one finding per parameter; focal_px: of the rectified pair."""
    return [_finding(p, estimate, focal_px) for p in estimate.parameters]


def corrected(
    rig: RigCalibration, measured: MeasuredCalibration, held: Container[str] = ()
) -> tuple[RigCalibration, dict[str, float]]:
    """Return `rig` with its wrong parameters but those `held` corrected, given the others; the corrections by parameter, in its unit."""
    wrong = [p for p in measured.wrong() if p.value not in held]
    if measured.estimate is None or not wrong:
        return rig, {}
    chosen = tuple(replace(p, is_judged=p.name in wrong) for p in measured.estimate.parameters)
    only = replace(measured.estimate, parameters=chosen)
    by_parameter = zip(only.parameters, only.corrections(), strict=False)
    return only.corrected(rig), {p.name.value: round(float(value), 7) for p, value in by_parameter if p.is_judged}


def in_words(name: str, value: float) -> str:
    """Return a correction as text, such as `-4.65 %`."""
    factor, shown, digits = SHOWN[P(name).unit]
    return f"{factor * value:+.{digits}f} {shown}"


def unknown_calibration(reason: str, missing: str) -> MeasuredCalibration:
    """Return all parameters as not judged, for the same reason."""
    return MeasuredCalibration([not_judged(p.value, reason, missing) for p in P], None)


def _finding(parameter: ParameterEstimate, estimate: CalibrationEstimate, focal_px: float) -> Finding:
    name = parameter.name
    factor, unit, digits = SHOWN[name.unit]
    value, own_sigma = _net(parameter, estimate, focal_px)
    sigma_all = float(np.hypot(own_sigma, name.least_sigma))
    sure = max(abs(value) - SURE_SIGMAS * sigma_all, 0.0)
    is_bad, is_coarse = parameter.is_judged and sure > name.warn_above, own_sigma > name.warn_above
    if not is_bad and (is_coarse or not parameter.is_judged):
        sigma = f"known to {factor * parameter.sigma:.{digits}f} {unit} only"
        return not_judged(name.value, sigma, parameter.reason or _LONGER)
    verdict = Verdict.FAIL if sure > name.fail_above else Verdict.WARN if is_bad else Verdict.OK
    words = f"{factor * value:+.{digits}f} {unit} from the calibration, sigma {factor * sigma_all:.{digits}f}"
    if name not in COLUMNS:
        words = f"{1 + value:.1f} times the data sheet, sigma {sigma_all:.1f}"
    if not is_bad and abs(value) > name.warn_above + sigma_all:  # large but uncertain: worth a warning
        return replace(not_judged(name.value, f"{words}: that may be chance", _LONGER), value=value)
    if is_bad:
        words += "; calibrate again, or name the matching file with --calibration"
    limits = f"warn {factor * name.warn_above:g}, fail {factor * name.fail_above:g} {unit} for sure"
    return Finding(name.value, verdict, value, limits, words, _LONGER if is_bad and is_coarse else "")


def _net(parameter: ParameterEstimate, estimate: CalibrationEstimate, focal_px: float) -> tuple[float, float]:
    """Return estimate and sigma; for a rotation against the IMU the part not cancelled by an equivalent shift of the principal point."""
    if parameter.name not in _SAME_BEARING:
        return parameter.estimate, parameter.sigma
    other, sign = _SAME_BEARING[parameter.name]
    names = [p.name for p in estimate.parameters[: len(estimate.covariance)]]
    row: Array = np.zeros(len(names))
    row[names.index(parameter.name)], row[names.index(other)] = 1.0, sign / focal_px
    values = np.array([p.estimate for p in estimate.parameters[: len(names)]])
    return float(row @ values), float(np.sqrt(row @ estimate.covariance @ row))
