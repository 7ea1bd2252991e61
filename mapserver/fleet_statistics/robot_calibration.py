"""Calibration of a robot's cameras from its health reports. Pure."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

PREFIX, SIGMA, DRIFTS = "calibration_", "_sigma", "calibration_drifts"
PARAMETERS = {
    "focal_scale": "focal length",
    "baseline_scale": "baseline",
    "pair_yaw_deg": "pair, turn",
    "right_focal_scale": "right focal length",
    "pair_roll_deg": "pair, roll",
    "pair_pitch_deg": "pair, pitch",
    "camera_roll_deg": "cameras, roll",
    "camera_pitch_deg": "cameras, pitch",
    "camera_yaw_deg": "cameras, turn",
    "camera_height_m": "cameras, height",
    "time_offset_s": "time offset",
}
"""Parameters by the name of their figure, with display names. Others sent by robots are left out."""


class CalibrationFigure(NamedTuple):
    """One parameter: its difference to the robot's calibration by the map, in the unit at the end of its name.

    name: a key of PARAMETERS. is_drifted: True if the robot reports a significant difference above the tolerance.
    """

    name: str
    value: float
    sigma: float
    is_drifted: bool

    @property
    def words(self) -> str:
        """Value and sigma with their unit."""
        if self.name.endswith("_scale"):
            return f"{100 * self.value:+.2f} ± {100 * self.sigma:.2f} %"
        scale, unit = (1e3, "ms") if self.name.endswith("_s") else (1.0, self.name.rpartition("_")[2])
        return f"{scale * self.value:+.3g} ± {scale * self.sigma:.2g} {'°' if unit == 'deg' else unit}"


def calibration_figures(health: Mapping[str, Any] | None) -> tuple[CalibrationFigure, ...]:
    """Return the parameters of a robot's last health report, as plain values; empty for a robot that does not report them."""
    metrics = (health or {}).get("metrics") or {}
    drifted = metrics.get(DRIFTS)
    names = set(drifted.split(",")) if isinstance(drifted, str) else set()
    found = []
    for name in PARAMETERS:
        value, sigma = number_of(metrics.get(PREFIX + name)), number_of(metrics.get(f"{PREFIX}{name}{SIGMA}"))
        if value is not None and sigma is not None:
            found.append(CalibrationFigure(name, value, sigma, name in names))
    return tuple(found)


def number_of(value: object) -> float | None:
    """Return a figure of a robot as a finite number, None for anything else."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else None  # type: ignore[arg-type]
