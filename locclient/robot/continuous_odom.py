"""Published frame `odom`: continuous from the first localized pose on. Pure."""

from typing import NamedTuple

from fleetmap.geometry import Array, se3_inverse, transport_cov
from fleetmap.odometry.estimate import ContinuousFrame
from locclient.localization.estimate import Estimate


class PublishedPose(NamedTuple):
    """One estimate in the published frames; map_from_odom is None while there is no single pose.

    building_from_map: of the robot's map, None if the map does not define it. cov_rot_trans (6, 6): of map_from_base, map axes, about
    the base, None if the estimate has none. level: name of its level, of a building; else empty.
    """

    odom_from_base: Array
    map_from_odom: Array | None
    building_from_map: Array | None = None
    cov_rot_trans: Array | None = None
    level: str = ""

    @property
    def map_from_base(self) -> Array | None:
        """Return (4, 4), None while there is no single pose."""
        return None if self.map_from_odom is None else self.map_from_odom @ self.odom_from_base


class ContinuousOdom:
    """Converts successive estimates.

    The odometry redefines its frame when it estimates gravity, refines it or is initialized again. Before the first localized pose
    `odom` follows, because it is not yet used for navigation. Afterwards the difference goes into map_from_odom, which may jump, so
    that odom_from_base never does.
    """

    def __init__(self, base_from_body: Array) -> None:
        self._body_from_base = se3_inverse(base_from_body)
        self._frame = ContinuousFrame()
        self._is_localized = False

    def handle(self, estimate: Estimate) -> PublishedPose:
        """Return the pose to publish for this frame."""
        if not self._is_localized:
            self._frame = ContinuousFrame()
        odom_from_body = self._frame.handle(estimate.odometry)
        odom_from_base = odom_from_body @ self._body_from_base
        if estimate.map_from_body is None:
            return PublishedPose(odom_from_base, None)
        self._is_localized = True
        map_from_odom, cov_rot_trans = estimate.map_from_body @ se3_inverse(odom_from_body), estimate.cov_rot_trans
        if cov_rot_trans is not None:
            cov_rot_trans = transport_cov(cov_rot_trans, estimate.map_from_body[:3, :3] @ self._body_from_base[:3, 3])
        return PublishedPose(odom_from_base, map_from_odom, cov_rot_trans=cov_rot_trans)
