"""A position prior as users write it: X,Y,YAW,SIGMA_M."""

import numpy as np

from fleetmap.errors import UsageError
from fleetmap.geometry import se3, so3_exp
from fleetmap.sensors.samples import PositionPrior


def parse_prior(text: str | None, name: str = "prior") -> PositionPrior | None:
    """The prior of the base in `map`, its heading not constrained; None for None; UsageError for anything else."""
    if text is None:
        return None
    try:
        x_m, y_m, yaw_rad, sigma_m = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(f"{name} {text!r} is not X,Y,YAW,SIGMA_M: four numbers, metres and radians") from error
    if not np.isfinite([x_m, y_m, yaw_rad, sigma_m]).all() or not sigma_m > 0:
        raise UsageError(f"{name} {text!r}: all four must be finite numbers and SIGMA_M positive metres")
    covariance = np.diag([np.inf, np.inf, np.inf, sigma_m**2, sigma_m**2, np.inf])
    return PositionPrior(0, se3(so3_exp(np.array([0.0, 0.0, yaw_rad])), np.array([x_m, y_m, 0.0])), covariance)
