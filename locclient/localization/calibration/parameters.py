"""Calibration parameters that the map determines, and reports of their drift. Pure."""

from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array

DRIFT_SIGMAS = 5.0
"""Drift limit in sigmas of a parameter: p = 6e-7 for one test. Ten parameters and three windows, corrected by Bonferroni's inequality,
give at most 1.8e-5 for each independent window, about 30 m of driving: 3.3 % for a robot-day of 57 km if errors are normally
distributed, and less because the drift must also be large. The first look after a start is judged alone, by the six parameters of
the images: 3.4e-6 for each start, 8e-5 per day with one start per hour."""


class Parameter(NamedTuple):
    """One parameter: truth minus calibration; relative for a scale, else in radians or metres.

    figure: its name in health reports, with its unit; per_unit: units of the figure in one of the value. least_sigma: of the error
    shared with the map, which no number of looks averages away. limit: size that counts as drift in any look; below it, a camera
    parameter is judged by the position error that it causes at the robot's place (`BIAS_LIMIT_M`). text: for display.
    """

    figure: str
    per_unit: float
    least_sigma: float
    limit: float
    text: str


_DEG = 180.0 / np.pi
PARAMETERS = (
    Parameter("focal_scale", 1.0, 0.001, 0.005, "focal length of both cameras"),
    Parameter("baseline_scale", 1.0, 0.0015, 0.02, "baseline"),
    Parameter("pair_yaw_deg", _DEG, 1e-4, 9e-4, "turn of the right camera against the left one"),
    Parameter("right_focal_scale", 1.0, 0.0005, 0.003, "focal length of the right camera against the left one"),
    Parameter("pair_roll_deg", _DEG, 5e-4, 0.003, "roll of the right camera against the left one"),
    Parameter("pair_pitch_deg", _DEG, 3e-4, 0.0012, "pitch of the right camera against the left one"),
    Parameter("camera_roll_deg", _DEG, 0.0026, 0.01, "roll of the cameras against the IMU"),
    Parameter("camera_pitch_deg", _DEG, 0.0026, 0.01, "pitch of the cameras against the IMU"),
    Parameter("camera_yaw_deg", _DEG, 0.0026, 0.01, "turn of the cameras against the driving direction"),
    Parameter("camera_height_m", 1.0, 0.01, 0.03, "height of the cameras above the ground"),
)
"""Images determine the first six, gravity the next two, wheels the ninth, the ground the last.

Floors: usual difference of scales and rotations between good pairs and the survey's, by calibration and by the effect of lighting on
stereo matching. Limits: focal length, 1.5 cm at 3 m; the pair, an error of a few centimetres at 3 m in some places (0.05 degrees of
yaw are a third of a pixel of disparity). pair_pitch_deg: half a pixel off the row costs stereo matching a third of its points.
Rotations of the camera: beyond what the rotation of an unmeasured map may be wrong by (`UNKNOWN_ERROR`).
"""
TIME_OFFSET = Parameter("time_offset_s", 1.0, 0.0005, 0.01, "time of the cameras against the IMU")
"""Estimated and corrected by the odometry, so that a drift is reported but causes no error. Limit: 2 cm at 2 m/s."""
IMAGE = 6  # of PARAMETERS, the first ones
FOCAL, BASELINE, YAW, RIGHT_FOCAL, ROLL, PITCH = range(IMAGE)
TILT, HEADING, HEIGHT = slice(6, 8), 8, 9
COUNT = len(PARAMETERS)
BIAS_LIMIT_M = 0.015
"""Limit of the position error at the robot's present scene depths: half of the 3 cm that may stay unreported, because the same
parameter causes more elsewhere. If the mean square error by all parameters, from value and sigma, is below its square, errors above
3 cm (two sigmas) are excluded; otherwise the published covariance includes them."""


class Drift(NamedTuple):
    """A parameter's estimate with its sigma, in units of `Parameter`; bias_m: the position error that it causes, 0 if it is not judged
    by that; is_drifted: True beyond both DRIFT_SIGMAS and the parameter's limit."""

    parameter: Parameter
    value: float
    sigma: float
    bias_m: float
    is_drifted: bool

    @property
    def text(self) -> str:
        parameter, scale = self.parameter, self.parameter.per_unit
        if parameter.figure.endswith("_scale"):
            size = f"{100 * self.value:+.2f} % (sigma {100 * self.sigma:.2f} %)"
        else:
            unit = parameter.figure.rpartition("_")[2]
            size = f"{scale * self.value:+.3g} {unit} (sigma {scale * self.sigma:.2g})"
        cost = f", which moves the position by {100 * self.bias_m:.1f} cm" if self.bias_m else ""
        return f"{parameter.text}: {size} from what the calibration says{cost}"


class CalibrationState(NamedTuple):
    """Result of the watch: an estimate of each observable parameter, and the covariance (6, 6) that the calibration adds to the pose,
    rotation first, camera axes, None if an error of 3 cm is excluded. text: drifted parameters, the largest error first."""

    drifts: tuple[Drift, ...] = ()
    cov_bias_cam: Array | None = None
    text: str = ""

    @property
    def is_wrong(self) -> bool:
        return bool(self.text)

    @property
    def figures(self) -> dict[str, float | str]:
        """Return figures of a health report: estimates and sigmas by name, and the names of drifted parameters."""
        told: dict[str, float | str] = {}
        for drift in self.drifts:
            name, scale = f"calibration_{drift.parameter.figure}", drift.parameter.per_unit
            told |= {name: scale * drift.value, f"{name}_sigma": scale * drift.sigma}
        drifted = [drift.parameter.figure for drift in self.drifts if drift.is_drifted]
        return told | ({"calibration_drifts": ",".join(drifted)} if drifted else {})


NOT_JUDGED = CalibrationState()
