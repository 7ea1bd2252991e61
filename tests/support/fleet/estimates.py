"""Estimates as a localizer would give them, for tests of its subscribers."""

import numpy as np

from fleetmap.geometry import Array, se3
from fleetmap.messages import Status
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.relocalization.relocalizer import Fix
from locclient.localization.estimate import Estimate, Hypothesis


def estimate(
    stamp_s: float, status: Status = Status.TRACKING, *, x_m: float = 0.0, sigma_m: float = 0.02, fix: bool = False,
    refused: str = "", innovation: float | None = None, version: int | None = 3, change: Array | None = None,
    known: bool = True, hypotheses: int = 0,
) -> Estimate:  # fmt: skip
    """At x_m in `map`, 10 m further in `odom`; known: whether there is a place at all."""
    stamp_ns = round(stamp_s * 1e9)
    odometry = OdometryEstimate(
        stamp_ns, 0, se3(np.eye(3), np.array([10.0 + x_m, 0, 0])), 1e-6 * np.eye(6), np.array([1.0, 0, 0]), np.zeros(3),
        np.zeros(3), OdometryStatus.TRACKING, np.arange(50), 5.0, 1.0, False, True, change,
    )  # fmt: skip
    place = se3(np.eye(3), np.array([x_m, 0.0, 0.0])) if known else None
    covariance = np.diag([1e-4] * 3 + [sigma_m**2] * 3) if known else None
    own = Fix(np.eye(4), 1e-4 * np.eye(6), 40, 12) if fix else None
    others = tuple(Hypothesis(se3(np.eye(3), np.array([float(n), 0, 0])), 3) for n in range(hypotheses))
    return Estimate(stamp_ns, status, place, covariance, version, own, refused, innovation, others, odometry, {})
