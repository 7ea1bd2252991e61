"""Publishers of estimates to the robot's own programs. To add one: a class and a line in PUBLISHERS."""

import secrets
from collections.abc import Callable
from typing import Protocol

import numpy as np

from fleetmap.bus import Bus
from fleetmap.config import Section
from fleetmap.errors import UsageError
from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import EstimateMessage, Placement, encode_message, robot_key
from fleetmap.recordings.ros2.keys import attachment, ros_key
from fleetmap.recordings.ros2.messages import FrameLink, encode_frame_links, encode_prior, encode_text
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.estimate import Estimate
from locclient.robot.continuous_odom import PublishedPose

_MAX_HYPOTHESES = 16


class OutputSection(Section, frozen=True):
    """Format and endpoint of estimates. Without an endpoint they go to the map server's, or nowhere where there is none."""

    format: str = "messagepack"
    endpoint: str | None = None
    domain: int = 0
    pose_topic: str = "/localization/pose"
    status_topic: str = "/localization/status"
    tf_topic: str = "/tf"
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    publish_odom: bool = True


class Publisher(Protocol):
    """Sends estimates. One that cannot be sent at once is dropped: the next one replaces it."""

    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: Array) -> None:
        """Sends this estimate."""


class MessagePackPublisher:
    """EstimateMessage under the robot's key `estimate`."""

    def __init__(self, bus: Bus, site: str, robot: str, _: OutputSection) -> None:
        self._bus, self._key = bus, robot_key(site, robot, "estimate")

    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: Array) -> None:
        """See Publisher."""
        covariance = estimate.cov_rot_trans if published.map_from_odom is not None else None
        body_from_base = se3_inverse(base_from_body)
        hypotheses = estimate.hypotheses[:_MAX_HYPOTHESES]
        message = EstimateMessage(
            stamp_ns=estimate.stamp_ns,
            status=estimate.status.value,
            cause=estimate.cause.value,
            calibration=estimate.calibration.text[:2000],
            map_version=estimate.map_version,
            odom_from_base=Placement.of(published.odom_from_base),
            map_from_odom=None if published.map_from_odom is None else Placement.of(published.map_from_odom),
            cov_rot_trans=None if covariance is None else tuple(float(v) for v in covariance.ravel()),
            hypotheses=tuple(Placement.of(h.map_from_body @ body_from_base) for h in hypotheses),
        )
        self._bus.publish(self._key, encode_message(message), may_drop=True)


class Ros2Publisher:
    """PoseWithCovarianceStamped, TFMessage (map -> odom, odom -> base) and the status as String, as rmw_zenoh carries them."""

    def __init__(self, bus: Bus, _site: str, _robot: str, section: OutputSection) -> None:
        self._bus, self._section = bus, section
        self._gid, self._sequence = secrets.token_bytes(16), 0
        self._keys = {
            "pose": ros_key(section.domain, section.pose_topic, "geometry_msgs/PoseWithCovarianceStamped"),
            "tf": ros_key(section.domain, section.tf_topic, "tf2_msgs/TFMessage"),
            "status": ros_key(section.domain, section.status_topic, "std_msgs/String"),
        }

    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: Array) -> None:
        """See Publisher. A pose is sent only with its covariance, and is that of the base in the map."""
        section, stamp_ns = self._section, estimate.stamp_ns
        links = []
        if published.map_from_odom is not None:
            links.append(FrameLink(section.map_frame, section.odom_frame, published.map_from_odom))
            if estimate.cov_rot_trans is not None:
                map_from_base = published.map_from_odom @ published.odom_from_base
                prior = PositionPrior(stamp_ns, map_from_base, np.asarray(estimate.cov_rot_trans))
                self._send("pose", stamp_ns, encode_prior(prior, section.map_frame))
        if section.publish_odom:
            links.append(FrameLink(section.odom_frame, section.base_frame, published.odom_from_base))
        if links:
            self._send("tf", stamp_ns, encode_frame_links(stamp_ns, links))
        self._send("status", stamp_ns, encode_text(estimate.status.value))

    def _send(self, topic: str, stamp_ns: int, payload: bytes) -> None:
        self._sequence += 1
        note = attachment(self._sequence, stamp_ns, self._gid)
        self._bus.publish(self._keys[topic], payload, may_drop=True, attachment=note)


PUBLISHERS: dict[str, Callable[[Bus, str, str, OutputSection], Publisher]] = {
    "messagepack": MessagePackPublisher,
    "ros2": Ros2Publisher,
}


def open_publisher(bus: Bus, site: str, robot: str, section: OutputSection) -> Publisher:
    """The publisher that the section asks for; UsageError for an unknown format or a topic that is none."""
    if section.format not in PUBLISHERS:
        raise UsageError(f"[output] format = {section.format!r}; known are {', '.join(PUBLISHERS)}")
    return PUBLISHERS[section.format](bus, site, robot, section)
