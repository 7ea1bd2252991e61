"""Parameters of a calibration that the map can judge, and what is said of them. Pure."""

from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, turn_both
from locclient.localization.pose_covariance import transport_cov

DRIFT_SIGMAS = 5.0
"""Of a parameter's sigma, beyond which it has drifted: p = 6e-7 for one test. Ten parameters and three windows, corrected for by
Bonferroni's inequality, make at most 1.8e-5 for each independent window, some 30 m of driving: 3.3 % for a robot-day of 57 km, if the
errors are normally distributed. That the drift must also be large makes it less. The first view of a start is judged alone, by the six
parameters of the images: 3.4e-6 for each start, 8e-5 for one in every hour of a day."""


class Parameter(NamedTuple):
    """One parameter: truth minus calibration, as a share where it is a scale, else in radians or metres.

    figure: its name in health reports, with its unit; per_unit: units of the figure in one of the value. floor: sigma of what no number
    of views averages away, because the map shares it. limit: size that matters whatever is in view; below it, the error of the position
    that a parameter of the cameras causes where the robot is decides (`BIAS_LIMIT_M`). text: for people.
    """

    figure: str
    per_unit: float
    floor: float
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
    Parameter("camera_height_m", 1.0, 0.01, 0.03, "height of the cameras above the floor"),
)
"""Images decide the first six, gravity the next two, wheels the ninth, floors the last.

Floors: scales and turns of good pairs differ from the survey's by so much, by their own calibration and by what stereo matching makes
of another light. Limits: focal length, 1.5 cm at 3 m; the pair, what costs some centimetres at 3 m in one place or another (0.05 degrees
of turn are a third of a pixel of disparity). pair_pitch_deg: half a pixel beside the row costs stereo matching a third of its points.
The turns of the camera: beyond what the published covariance admits (`TrackSettings.map_sigma_rad`).
"""
TIME_OFFSET = Parameter("time_offset_s", 1.0, 0.0005, 0.01, "time of the cameras against the IMU")
"""As the odometry estimates it: corrected there, so that a drift is reported and costs nothing. Limit: 2 cm at 2 m/s."""
IMAGE = 6  # of PARAMETERS, the first ones
FOCAL, BASELINE, YAW, RIGHT_FOCAL, ROLL, PITCH = range(IMAGE)
TILT, HEADING, HEIGHT = slice(6, 8), 8, 9
COUNT = len(PARAMETERS)
BIAS_LIMIT_M = 0.015
"""Error of the position at the depths that the robot sees. A robot may be 3 cm off without a word; half of that is the limit, because
elsewhere the same parameter costs more. Where the mean square of what all parameters may cost, by value and sigma, is below its square,
more than 3 cm (two sigmas) are excluded; else the published covariance holds them."""


class Drift(NamedTuple):
    """A parameter's estimate with its sigma, as `Parameter` says; bias_m: the error of the position that it causes, 0 where that is not
    how it is judged; is_drifted: whether it is beyond DRIFT_SIGMAS and beyond the size that matters."""

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
    """What the watch knows: an estimate of each parameter that could be judged, and the covariance that the calibration adds to the pose
    (6, 6), rotation first, camera axes; None where an error of 3 cm is excluded. text: what is wrong, the costliest first."""

    drifts: tuple[Drift, ...] = ()
    cov_bias_cam: Array | None = None
    text: str = ""

    @property
    def is_wrong(self) -> bool:
        return bool(self.text)

    def cov_bias(self, map_from_cam: Array, map_from_body: Array) -> Array:
        """(6, 6) what the wrong parameters add to a pose's covariance: map axes, rotation first, about the body."""
        if self.cov_bias_cam is None:
            return np.zeros((6, 6))
        turn = turn_both(map_from_cam[:3, :3])
        return transport_cov(turn @ self.cov_bias_cam @ turn.T, map_from_body[:3, 3] - map_from_cam[:3, 3])

    @property
    def figures(self) -> dict[str, float | str]:
        """Of a health report: estimates and sigmas by name, and the names of those that have drifted."""
        told: dict[str, float | str] = {}
        for drift in self.drifts:
            name, scale = f"calibration_{drift.parameter.figure}", drift.parameter.per_unit
            told |= {name: scale * drift.value, f"{name}_sigma": scale * drift.sigma}
        drifted = [drift.parameter.figure for drift in self.drifts if drift.is_drifted]
        return told | ({"calibration_drifts": ",".join(drifted)} if drifted else {})


NOT_JUDGED = CalibrationState()
