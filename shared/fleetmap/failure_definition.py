"""Definition of a position failure, shared by robots, replays, the gate and the server's statistics. Pure.

A position failure begins when

* the status is TRACKING and the estimate is more than 0.30 m or 5 degrees off for longer than 1 s (a silent failure), or
* after the first fix the robot has been LOST, AMBIGUOUS, or DEGRADED with a 95 % radius above 0.30 m, for more than 2 s, or
* the error of any estimate leaves its own 99.9 % bound for longer than 1 s;

it ends after 5 s of good tracking. docs/reports.md says the same to users.
"""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.messages import Status

ERROR_LIMIT_M, ERROR_LIMIT_DEG = 0.30, 5.0
RADIUS_LIMIT_M = 0.30
SILENT_S, BLIND_S, GOOD_S = 1.0, 2.0, 5.0
CHI2_3_0999, CHI2_6_0999 = 16.266, 22.458  # 99.9 % of chi-square with 3 (a position) and 6 (a pose) degrees of freedom
_RADIUS_95_SIGMAS = 2.796  # 95 % of a three-dimensional normal distribution


def is_wrong(error_m: float, error_rad: float | None = None) -> bool:
    """Whether an estimate with these errors is off by more than a robot may be; without a known rotation the position decides."""
    return error_m > ERROR_LIMIT_M or (error_rad is not None and bool(np.degrees(error_rad) > ERROR_LIMIT_DEG))


def is_blind(status: str, radius_95_m: float) -> bool:
    """Whether there is no position that may be relied upon: lost, ambiguous, or degraded beyond RADIUS_LIMIT_M."""
    return status in {Status.LOST, Status.AMBIGUOUS} or (status == Status.DEGRADED and radius_95_m > RADIUS_LIMIT_M)


def is_usable(status: str, radius_95_m: float) -> bool:
    """Whether a position may be relied upon: tracking, or degraded within RADIUS_LIMIT_M."""
    return status == Status.TRACKING or (status == Status.DEGRADED and radius_95_m <= RADIUS_LIMIT_M)


def is_outside_bound(error_map_m: Array, cov_rot_trans: Array) -> bool:
    """Whether a position error (3,) leaves the 99.9 % bound of its covariance (6, 6), rotation first.

    Source: Bar-Shalom et al. 2001, section 5.4 (normalized estimation error squared).
    """
    return float(error_map_m @ np.linalg.solve(cov_rot_trans[3:, 3:], error_map_m)) > CHI2_3_0999


def radius_95_m(cov_rot_trans: Array | None) -> float:
    """Radius that holds the position with 95 %, for a covariance (6, 6), rotation first; infinite without one."""
    if cov_rot_trans is None:
        return float("inf")
    return _RADIUS_95_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(cov_rot_trans[3:, 3:])[-1]))
