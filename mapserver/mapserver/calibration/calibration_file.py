"""The file of a measured calibration, and its figures in words."""

import numpy as np

from fleetmap.recordings.calibration_files import format_calibration
from fleetmap.sensors.calibration import RigCalibration
from mapserver.calibration.estimate import CalibrationEstimate, ParameterEstimate

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
