"""A frame in which an odometry's estimates follow each other without a jump."""

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.odometry.estimate import OdometryEstimate


class ContinuousFrame:
    """Follows estimates one after the other by the motion between them.

    The odometry's own frame turns about its origin whenever gravity becomes better known: after 17 m a third of a degree in a first
    bend moves every pose by 10 cm. frame_from_odom (4, 4) takes that up; it may be set to begin anew.
    """

    def __init__(self) -> None:
        self.frame_from_odom = np.eye(4)
        self._frame_from_last: Array | None = None

    def handle(self, estimate: OdometryEstimate) -> Array:
        """frame_from_body (4, 4) at the estimate's frame."""
        motion, change = estimate.previous_from_body, estimate.new_odom_from_old_odom
        if self._frame_from_last is None:
            pass  # nothing to go on from
        elif motion is not None:
            self.frame_from_odom = self._frame_from_last @ motion @ se3_inverse(estimate.odom_from_body)
        elif change is not None:
            self.frame_from_odom = self.frame_from_odom @ se3_inverse(change)
        self._frame_from_last = np.asarray(self.frame_from_odom @ estimate.odom_from_body)
        return self._frame_from_last
