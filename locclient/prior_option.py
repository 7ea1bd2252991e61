"""Position priors from the option X,Y,YAW,SIGMA_M, and from an operator's message by the server."""

import numpy as np

from fleetmap.errors import LinkError, UsageError
from fleetmap.geometry import se3, so3_exp
from fleetmap.messages import InitialPoseMessage
from fleetmap.sensors.samples import UNSAID_SIGMAS, PositionPrior


def parse_prior(text: str | None, name: str = "prior") -> PositionPrior | None:
    """Parse a prior of the base in `map`, with unconstrained heading; None for None; UsageError for invalid text."""
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


def told_prior(told: InitialPoseMessage) -> PositionPrior:
    """Return an operator's pose, on the robot's own site, as a prior that overrides the tracked pose until fixes outweigh it.

    LinkError for an invalid one.
    """
    values = [told.x_map_m, told.y_map_m, told.heading_rad or 0.0, told.sigma_m]
    if not np.isfinite(values).all() or not told.sigma_m >= 1e-3:  # nobody knows a place better than to a millimetre
        raise LinkError(f"invalid initial pose: {values[:2]} m, heading {told.heading_rad} rad, sigma {told.sigma_m} m")
    sigmas = UNSAID_SIGMAS.copy()
    sigmas[3:5] = told.sigma_m
    if told.heading_rad is None:
        sigmas[2] = np.inf
    map_from_base = se3(so3_exp(np.array([0.0, 0.0, told.heading_rad or 0.0])), np.array([*values[:2], 0.0]))
    return PositionPrior(0, map_from_base, np.diag(sigmas**2), True, "")
