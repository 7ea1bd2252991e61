"""A survey under way as ROS 2 messages, as rmw_zenoh carries them: Foxglove and RViz show it, seen from above."""

import secrets

import numpy as np

from fleetmap.bus import Bus
from fleetmap.geometry import Array
from fleetmap.live_survey import LiveSurveyState
from fleetmap.recordings.ros2.keys import attachment, ros_key
from fleetmap.recordings.ros2.messages import (
    FrameLink,
    encode_frame_links,
    encode_path,
    encode_points,
    encode_prior,
    encode_text,
)
from fleetmap.sensors.samples import PositionPrior

MAP, ODOM, BASE = "map", "odom", "base_link"
TOPICS = {
    "/live/path": "nav_msgs/Path",
    "/live/landmarks": "sensor_msgs/PointCloud2",
    "/live/pose": "geometry_msgs/PoseWithCovarianceStamped",
    "/live/status": "std_msgs/String",
    "/tf": "tf2_msgs/TFMessage",
}


class Ros2View:
    """Publishes states; a pose is sent only with its covariance."""

    def __init__(self, bus: Bus, domain: int = 0) -> None:
        self._bus, self._gid, self._sequence = bus, secrets.token_bytes(16), 0
        self._keys = {topic: ros_key(domain, topic, type_name) for topic, type_name in TOPICS.items()}

    def show(self, state: LiveSurveyState) -> None:
        """One more state; LinkError where the bus is closed."""
        stamp_ns, estimate = state.stamp_ns, state.estimate
        self._send("/live/path", stamp_ns, encode_path(stamp_ns, MAP, _from_above(state.path())))
        self._send("/live/landmarks", stamp_ns, encode_points(stamp_ns, MAP, _from_above(state.landmarks())))
        if estimate is None:
            self._send("/live/status", stamp_ns, encode_text(state.phase))
            return
        self._send("/live/status", stamp_ns, encode_text(estimate.status))
        odom_from_base, at_ns = estimate.odom_from_base.target_from_source, estimate.stamp_ns
        links = [FrameLink(ODOM, BASE, odom_from_base)]
        if estimate.map_from_odom is not None:
            map_from_odom = estimate.map_from_odom.target_from_source
            links.insert(0, FrameLink(MAP, ODOM, map_from_odom))
            if estimate.cov_rot_trans is not None:
                cov = np.reshape(estimate.cov_rot_trans, (6, 6))
                prior = PositionPrior(at_ns, map_from_odom @ odom_from_base, cov)
                self._send("/live/pose", at_ns, encode_prior(prior, MAP))
        self._send("/tf", at_ns, encode_frame_links(at_ns, links))

    def _send(self, topic: str, stamp_ns: int, payload: bytes) -> None:
        self._sequence += 1
        note = attachment(self._sequence, stamp_ns, self._gid)
        self._bus.publish(self._keys[topic], payload, may_drop=True, attachment=note)


def _from_above(rows: Array) -> Array:
    return np.column_stack([rows[:, :2], np.zeros(len(rows))])
