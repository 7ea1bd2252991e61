"""Definition of a position failure, shared by robots, replays, the gate and the server's statistics. Pure.

A position failure begins when

* the status is TRACKING and the estimate is more than 0.30 m or 5 degrees off for longer than 1 s (a silent failure), or
* after the first fix the robot has been LOST, AMBIGUOUS, or DEGRADED with a 95 % radius above 0.30 m, for more than 2 s, or
* the error of any estimate leaves its own 99.9 % bound for longer than 1 s, or
* the robot does not find itself: 20 s of driving or 60 s of standing since the start, or since it was last localised, at a place that
  the map covers or that nobody can say it does not;

it ends after 5 s of good tracking. One that lasts is one failure. docs/reports.md says the same to users.
"""

from collections.abc import Iterable
from math import hypot

import numpy as np

from fleetmap.geometry import Array
from fleetmap.messages import Status

ERROR_LIMIT_M, ERROR_LIMIT_DEG = 0.30, 5.0
RADIUS_LIMIT_M = 0.30
SILENT_S, BLIND_S, GOOD_S = 1.0, 2.0, 5.0
FIND_DRIVING_S, FIND_AT_REST_S = 20.0, 60.0
DRIVING_MPS = 0.05
SPARSE_S = 1.0  # frames farther apart than this are localised by a fix of their own
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


def is_driving(speed_mps: float | None) -> bool:
    """Whether a robot drives. One whose speed nobody knows counts as driving: the shorter time then decides when it has failed."""
    return speed_mps is None or abs(speed_mps) >= DRIVING_MPS


def is_localised(status: str, has_fix: bool, radius_95_m: float, gap_s: float) -> bool:
    """Whether the robot knows its place: tracking; or, far in time from the frames beside it, by a fix that its position rests on."""
    return status == Status.TRACKING or (has_fix and radius_95_m <= RADIUS_LIMIT_M and gap_s > SPARSE_S)


def is_found(is_localised: bool, has_fix: bool, status: str, radius_95_m: float) -> bool:
    """Whether a frame or report shows that the robot knows where it is: localised, or a fix behind a position to be relied upon."""
    return is_localised or (has_fix and is_usable(status, radius_95_m))


def may_be_mapped(x_m: float, y_m: float, radius_95_m: float, cells: Iterable[tuple[int, int]], size_m: float) -> bool:
    """Whether a map with tiles of size_m at `cells` may cover a position: one of them is within radius_95_m and the size of a tile.

    From farther away, landmarks of a tile are beyond what its survey saw of them. A radius without bound admits every place.
    """
    reach_m = radius_95_m + size_m
    return any(
        hypot(max(x * size_m - x_m, 0.0, x_m - (x + 1) * size_m), max(y * size_m - y_m, 0.0, y_m - (y + 1) * size_m))
        <= reach_m
        for x, y in cells
    )


class SearchClock:
    """Time that a robot has searched for itself, driving and standing, since the start or since it was last found."""

    def __init__(self) -> None:
        self.began_ns: int | None = None  # stamp of the first frame that was not found, None while the robot is
        self._last_ns: int | None = None
        self._driven_s = self._stood_s = 0.0

    @property
    def is_over(self) -> bool:
        """Whether the search has lasted so long that it is a failure."""
        return self._driven_s >= FIND_DRIVING_S or self._stood_s >= FIND_AT_REST_S

    def handle(self, stamp_ns: int, *, is_found: bool, is_driving: bool, may_be_mapped: bool = True) -> bool:
        """Whether the robot does not find itself, with the frame or report at stamp_ns, which speaks for the time since the one before.

        Time at a place that the map does not cover is not counted.
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
        return self.is_over


def is_outside_bound(error_map_m: Array, cov_rot_trans: Array) -> bool:
    """Whether a position error (3,) leaves the 99.9 % bound of its covariance (6, 6), rotation first.

    Source: Bar-Shalom et al. 2001, section 5.4 (normalized estimation error squared).
    """
    return float(error_map_m @ np.linalg.solve(cov_rot_trans[3:, 3:], error_map_m)) > CHI2_3_0999


def radius_95_m(cov_rot_trans: Array | None) -> float:
    """Radius that holds the position with 95 %, for a covariance (6, 6), rotation first; infinite without one,
    and for one that is not finite, as odometry leaves it where a robot has lost most of its frames."""
    if cov_rot_trans is None or not np.isfinite(cov_rot_trans[3:, 3:]).all():
        return float("inf")
    return _RADIUS_95_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(cov_rot_trans[3:, 3:])[-1]))
