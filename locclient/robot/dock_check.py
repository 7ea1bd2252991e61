"""Distance between estimate and dock at an arrival: the only ground truth that a robot in service meets. Pure."""

from collections.abc import Iterable

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import Status
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.estimate import Estimate

_EXACT_M = 0.1  # sigma up to which a position prior is a dock's; three sigmas are the limit of a failure
_LEFT_M = 1.0  # distance travelled after which the next report of a dock is another arrival
_STALE_M = 0.05  # distance travelled between a dock's report and the frame beyond which the two cannot be compared


class DockCheck:
    """Compares the reports of docks with estimates that were TRACKING before; once for each arrival."""

    def __init__(self, base_from_body: Array) -> None:
        self._body_from_base = se3_inverse(base_from_body)
        self._was_tracking = False
        self._last_m: Array | None = None
        self._path_m = np.inf

    def handle(self, priors: Iterable[PositionPrior], estimate: Estimate) -> float | None:
        """Horizontal distance between the estimate of a frame and the dock among the priors that came with it.

        None without a dock, where the robot was not TRACKING, and for docks that repeat themselves while it stands.
        """
        self._follow(estimate)
        was_tracking, self._was_tracking = self._was_tracking, estimate.status is Status.TRACKING
        exact = [prior for prior in priors if _is_exact(prior)]
        if not exact:
            return None
        arrives, self._path_m = self._path_m > _LEFT_M, 0.0
        dock = exact[-1]
        speed_mps = float(np.linalg.norm(estimate.odometry.velocity_odom_mps))
        is_stale = speed_mps * abs(estimate.stamp_ns - dock.stamp_ns) * 1e-9 > _STALE_M
        if not (arrives and was_tracking and self._was_tracking) or is_stale or estimate.map_from_body is None:
            return None
        map_from_base = estimate.map_from_body @ self._body_from_base
        return float(np.linalg.norm(map_from_base[:2, 3] - dock.map_from_base[:2, 3]))

    def _follow(self, estimate: Estimate) -> None:
        """Counts the distance travelled, also where the odometry redefines its frame."""
        now_m, change = estimate.odometry.odom_from_body[:3, 3], estimate.odometry.new_odom_from_old_odom
        if self._last_m is not None:
            last_m = self._last_m if change is None else change[:3, :3] @ self._last_m + change[:3, 3]
            self._path_m += float(np.linalg.norm(now_m - last_m))
        self._last_m = now_m


def _is_exact(prior: PositionPrior) -> bool:
    """Whether this is a dock's report, not a zone or an operator's estimate."""
    covariance = prior.cov_rot_trans[3:5, 3:5]
    return not prior.is_revisable and bool(
        np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[-1] <= _EXACT_M**2
    )
