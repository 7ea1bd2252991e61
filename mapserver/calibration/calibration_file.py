"""The file of a measured calibration, and its figures in words."""

import numpy as np

from fleetmap.geometry import se3_inverse, so3_log
from fleetmap.recordings.calibration_files import format_calibration
from fleetmap.sensors.calibration import RigCalibration
from mapserver.calibration.estimate import CalibrationEstimate, ParameterEstimate
from mapserver.calibration.from_guess import GuessedCalibration

_SCALES = {
    "": (100.0, "%"),
    "rad": (float(np.degrees(1.0)), "deg"),
    "s": (1e3, "ms"),
    "m": (1e3, "mm"),
    "px": (1.0, "px"),
}


def in_words(parameter: ParameterEstimate) -> tuple[str, str]:
    """A correction and its sigma, in per cent, degrees, milliseconds, millimetres or pixels."""
    scale, unit = _SCALES[parameter.unit]
    return f"{parameter.estimate * scale:+.3f} {unit}", f"{parameter.sigma * scale:.3f} {unit}"


def corrected_file(estimate: CalibrationEstimate, rig: RigCalibration, names: list[str]) -> str:
    """The text of a camchain: the corrected rig, and in comments what was measured and what kept its value."""
    lines = [f"# Measured by `mapserver calibrate` from {', '.join(names)}."]
    for p in estimate.parameters:
        value, sigma = in_words(p)
        what = f"corrected by {value}, sigma {sigma}" if p.is_judged else f"NOT JUDGED, old value kept: {p.reason}"
        lines.append(f"# {p.name.value}: {what}")
    lines.append("# The wheels' scale and the IMU's noise are for information: this file keeps the noise that it had.")
    return "\n".join(lines) + "\n" + format_calibration(estimate.corrected(rig))


def guessed_in_words(found: GuessedCalibration) -> list[str]:
    """What images alone showed, and what they cannot."""
    left, right = found.rig.cameras
    turn = np.degrees(so3_log((se3_inverse(left.body_from_cam) @ right.body_from_cam)[:3, :3]))
    lenses = [
        f"cam{n}: focal length {c.intrinsics_px[0]:.1f} px, sigma {found.focal_sigma * c.intrinsics_px[0]:.1f}; centre "
        f"{c.intrinsics_px[2]:.1f} {c.intrinsics_px[3]:.1f}; distortion {' '.join(f'{k:+.4f}' for k in c.distortion)}"
        for n, c in enumerate((left, right))
    ]
    angles = f"cam1 is turned against cam0 by {turn[0]:+.2f} {turn[1]:+.2f} {turn[2]:+.2f} degrees"
    lacking = "not judged: the baseline's length, which is as given, and how IMU and wheels are mounted"
    return [*lenses, angles, lacking, f"{found.keyframes} keyframes, {found.passes} passes, images alone"]


def guessed_file(found: GuessedCalibration, name: str) -> str:
    """The text of a camchain of what was found from a guess."""
    lines = [f"# Found by `mapserver calibrate` from {name}, beginning with focal length = image width."]
    return (
        "\n".join([*lines, *(f"# {line}" for line in guessed_in_words(found))]) + "\n" + format_calibration(found.rig)
    )
