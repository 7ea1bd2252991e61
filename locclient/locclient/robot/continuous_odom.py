"""The frame `odom` that a robot publishes: continuous from the first localized pose on. Pure."""

from dataclasses import dataclass

from fleetmap.geometry import Array, se3_inverse
from fleetmap.odometry import ContinuousFrame
from locclient.localization.estimate import Estimate


@dataclass(frozen=True, slots=True)
class PublishedPose:
    """One estimate in the published frames; map_from_odom is None while there is no single pose.

    building_from_map: of the map that the robot uses, None where that does not say it.
    """

    odom_from_base: Array
    map_from_odom: Array | None
    building_from_map: Array | None = None


class ContinuousOdom:
    """Follows estimates one after another.

    The odometry redefines its own frame when it finds gravity, knows it better or is initialized again. Before the first localized pose
    `odom` follows it, because nobody navigates by it yet. Afterwards the difference goes into map_from_odom, which may jump, so that
    odom_from_base never does.
    """

    def __init__(self, base_from_body: Array) -> None:
        self._body_from_base = se3_inverse(base_from_body)
        self._frame = ContinuousFrame()
        self._is_localized = False

    def handle(self, estimate: Estimate) -> PublishedPose:
        """The pose to publish for this frame."""
        if not self._is_localized:
            self._frame = ContinuousFrame()
        odom_from_body = self._frame.handle(estimate.odometry)
        odom_from_base = odom_from_body @ self._body_from_base
        if estimate.map_from_body is None:
            return PublishedPose(odom_from_base, None)
        self._is_localized = True
        return PublishedPose(odom_from_base, estimate.map_from_body @ se3_inverse(odom_from_body))
