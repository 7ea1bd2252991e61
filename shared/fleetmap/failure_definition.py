"""Definition of a position failure, shared by robots, replays, the gate and the server's statistics. Pure.

A position failure begins when

* the status is TRACKING and the estimate is more than 0.30 m or 5 degrees off for longer than 1 s (a silent failure), or
* after the first fix the robot has been LOST, AMBIGUOUS, or DEGRADED with a 95 % radius above 0.30 m, for more than 2 s, or
* the error of any estimate leaves its own 99.9 % bound for longer than 1 s, or
* the robot cannot localize itself: 20 s of driving or 60 s of standing since the start, or since it was last localized, at a place that
  the map covers or may cover;

it ends after 5 s of good tracking. A lasting failure counts once. docs/reports.md has the definition for users.
"""

from math import acos, cos, inf, sqrt

import numpy as np

from fleetmap.geometry import Array
from fleetmap.messages import Status

ERROR_LIMIT_M, ERROR_LIMIT_DEG = 0.30, 5.0
RADIUS_LIMIT_M = 0.30
SILENT_S, BLIND_S, GOOD_S = 1.0, 2.0, 5.0
FIND_DRIVING_S, FIND_AT_REST_S = 20.0, 60.0
DRIVING_MPS = 0.05
SPARSE_S = 1.0  # frames farther apart than this each need their own fix to count as localised
CHI2_3_0999, CHI2_6_0999 = 16.266, 22.458  # 99.9 % of chi-square with 3 (a position) and 6 (a pose) degrees of freedom
_UNKNOWN = 1e300  # of a cubed variance in m^2
_RADIUS_95_SIGMAS = 2.796  # 95 % of a three-dimensional normal distribution


def is_wrong(error_m: float, error_rad: float | None = None) -> bool:
    """True if an estimate's errors exceed the limits; without a known rotation the position decides."""
    return error_m > ERROR_LIMIT_M or (error_rad is not None and bool(np.degrees(error_rad) > ERROR_LIMIT_DEG))


def is_blind(status: str, radius_95_m: float) -> bool:
    """True without a reliable position: lost, ambiguous, or degraded beyond RADIUS_LIMIT_M."""
    return status in {Status.LOST, Status.AMBIGUOUS} or (status == Status.DEGRADED and radius_95_m > RADIUS_LIMIT_M)


def is_usable(status: str, radius_95_m: float) -> bool:
    """True if the position is reliable: tracking, or degraded within RADIUS_LIMIT_M."""
    return status == Status.TRACKING or (status == Status.DEGRADED and radius_95_m <= RADIUS_LIMIT_M)


def is_driving(speed_mps: float | None) -> bool:
    """True if the robot drives. A robot of unknown speed counts as driving, so that the shorter time limit applies."""
    return speed_mps is None or abs(speed_mps) >= DRIVING_MPS


def is_localised(status: str, has_fix: bool, radius_95_m: float, gap_s: float) -> bool:
    """True if the robot knows its place: tracking, or, far in time from neighbouring frames, a fix that supports its position."""
    return status == Status.TRACKING or (has_fix and radius_95_m <= RADIUS_LIMIT_M and gap_s > SPARSE_S)


def is_found(is_localised: bool, has_fix: bool, status: str, radius_95_m: float) -> bool:
    """True if a frame or report shows that the robot knows its place: localised, or a fix behind a reliable position."""
    return is_localised or (has_fix and is_usable(status, radius_95_m))


class SearchClock:
    """Time of a robot's search for its place, driving and standing, since the start or since it was last localised."""

    def __init__(self) -> None:
        self.began_ns: int | None = None  # stamp of the first frame of the search, None while the robot is localised
        self._last_ns: int | None = None
        self._driven_s = self._stood_s = 0.0

    def handle(self, stamp_ns: int, *, is_found: bool, is_driving: bool, may_be_mapped: bool = True) -> bool:
        """Add a frame or report at stamp_ns, which covers the time since the previous one; return True if the search is a failure.

        Time outside the map is not counted.
        """
        dt_s = 0.0 if self._last_ns is None else max(0, stamp_ns - self._last_ns) * 1e-9
        self._last_ns = stamp_ns
        if is_found:
            self.began_ns, self._driven_s, self._stood_s = None, 0.0, 0.0
            return False
        if self.began_ns is None:
            self.began_ns = stamp_ns
        if may_be_mapped and is_driving:
            self._driven_s += dt_s
        elif may_be_mapped:
            self._stood_s += dt_s
        return self._driven_s >= FIND_DRIVING_S or self._stood_s >= FIND_AT_REST_S


def is_outside_bound(error_map_m: Array, cov_rot_trans: Array) -> bool:
    """True if a position error (3,) exceeds the 99.9 % bound of its covariance (6, 6), rotation first.

    Source: Bar-Shalom et al. 2001, section 5.4 (normalized estimation error squared).
    """
    return float(error_map_m @ np.linalg.solve(cov_rot_trans[3:, 3:], error_map_m)) > CHI2_3_0999


def radius_95_m(cov_rot_trans: Array | None) -> float:
    """Radius that contains the position with probability 95 %, for a covariance (6, 6), rotation first; infinite without one
    and for a covariance that is not finite, as odometry gives it after a robot has lost most of its frames."""
    if cov_rot_trans is None:
        return inf
    # The largest eigenvalue as a root of the characteristic polynomial, in an eighth of LAPACK's time. Source: Smith 1961.
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = cov_rot_trans[3:, 3:].tolist()
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    cube = spread * spread * spread
    if not mean + cube < _UNKNOWN:
        return inf
    half = 0.5 * (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz))
    cosine = half / cube if cube > 0.0 else 1.0
    largest = mean + 2.0 * spread * cos(acos(min(max(cosine, -1.0), 1.0)) / 3.0)
    return _RADIUS_95_SIGMAS * sqrt(largest) if largest >= 0.0 else inf  # numbers that lost their meaning bound nothing


def known_radius_m(cov_rot_trans: Array | None) -> float | None:
    """As `radius_95_m`, for messages: None where it is infinite."""
    radius_m = radius_95_m(cov_rot_trans)
    return radius_m if np.isfinite(radius_m) else None
