"""The frame `odom` that a robot publishes: continuous for ever once a place has been named in it. Pure."""

from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from locclient.localization.estimate import Estimate


@dataclass(frozen=True, slots=True)
class PublishedPose:
    """One estimate in the published frames; map_from_odom is None while there is no single pose."""

    odom_from_base: Array
    map_from_odom: Array | None


class ContinuousOdom:
    """Follows estimates one after another.

    The odometry redefines its own frame when it finds gravity, or begins anew. Before the first place that is taken over, because
    nobody steers by it yet; after it the difference goes into map_from_odom, which may jump, so that odom_from_base never does.
    """

    def __init__(self, base_from_body: Array) -> None:
        self._body_from_base = se3_inverse(base_from_body)
        self._odom_from_own = np.eye(4)
        self._named = False

    def handle(self, estimate: Estimate) -> PublishedPose:
        """What is published for this frame."""
        change = estimate.odometry.new_odom_from_old_odom
        if change is not None and self._named:
            self._odom_from_own = self._odom_from_own @ se3_inverse(change)
        odom_from_body = self._odom_from_own @ estimate.odometry.odom_from_body
        if estimate.map_from_body is None:
            return PublishedPose(odom_from_body @ self._body_from_base, None)
        self._named = True
        return PublishedPose(
            odom_from_body @ self._body_from_base, estimate.map_from_body @ se3_inverse(odom_from_body)
        )
