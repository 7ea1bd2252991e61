"""A survey as ROS 2 topics: read back field by field, as the message definitions have them."""

import struct

import numpy as np

from fleetmap.bus import MemoryBus, MemoryHub
from fleetmap.geometry import se3
from fleetmap.live_survey import LiveSurveyState
from fleetmap.messages import EstimateMessage, Placement
from fleetmap.recordings.ros2.cdr import CdrReader
from fleetmap.recordings.ros2.keys import type_of_key
from fleetmap.recordings.ros2.messages import decode_frame_links, decode_prior
from mapserver.live.ros2_view import TOPICS, Ros2View

WAY = np.array([[0.0, 0.0], [1.0, 0.5], [2.0, 0.5]])
MARKS = np.array([[3.0, 4.0], [5.0, -6.0]])
STATE = LiveSurveyState(
    site="hall", recording="monday", stamp_ns=7_000_000_001, phase="tracking", seconds=2.0, frames=40, keyframes=3,
    path_m=WAY.astype("<f4").tobytes(), quality=bytes([255, 255, 0]), landmarks_m=MARKS.astype("<f4").tobytes(),
    estimate=EstimateMessage(
        stamp_ns=6_000_000_000, status="TRACKING", map_version=None, odom_from_base=Placement.of(se3(np.eye(3), np.array([1.0, 0, 0]))),
        map_from_odom=Placement.of(se3(np.eye(3), np.array([0, 2.0, 0]))),
        cov_rot_trans=tuple(np.diag([1.0, 2, 3, 4, 5, 6]).ravel().tolist()),
    ),
)  # fmt: skip


def shown(state: LiveSurveyState) -> dict[str, bytes]:
    """What was published, by type."""
    found = dict[str, bytes]()
    with MemoryBus(MemoryHub()) as bus:
        bus.subscribe("0/**", lambda key, payload: found.update({type_of_key(key): payload}))
        Ros2View(bus).show(state)
    return found


def test_everything_that_the_state_knows_is_shown() -> None:
    found = shown(STATE)
    assert set(found) == set(TOPICS.values())
    path = CdrReader(found["nav_msgs/Path"])
    assert (path.stamp_ns(), path.text(), path.unsigned()) == (STATE.stamp_ns, "map", 3)
    for place in WAY:
        assert (path.stamp_ns(), path.text()) == (STATE.stamp_ns, "map")
        np.testing.assert_allclose(path.doubles(7), [*place, 0, 0, 0, 0, 1])
    prior = decode_prior(found["geometry_msgs/PoseWithCovarianceStamped"])
    np.testing.assert_allclose(prior.map_from_base[:3, 3], [1, 2, 0])
    np.testing.assert_allclose(np.diag(prior.cov_rot_trans), [1, 2, 3, 4, 5, 6])
    links = decode_frame_links(found["tf2_msgs/TFMessage"])
    assert [(link.parent, link.child) for link in links] == [("map", "odom"), ("odom", "base_link")]
    assert CdrReader(found["std_msgs/String"]).text() == "TRACKING"


def test_a_cloud_has_its_points_as_float32() -> None:
    cloud = CdrReader(shown(STATE)["sensor_msgs/PointCloud2"])
    assert (cloud.stamp_ns(), cloud.text()) == (STATE.stamp_ns, "map")
    assert [cloud.unsigned() for _ in range(3)] == [1, 2, 3]
    fields = [(cloud.text(), cloud.unsigned(), cloud.byte(), cloud.unsigned()) for _ in range(3)]
    assert fields == [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)]
    assert (cloud.byte(), cloud.unsigned(), cloud.unsigned()) == (0, 12, 24)
    assert struct.unpack("<6f", cloud.blob()) == (3, 4, 0, 5, -6, 0)
    assert cloud.byte() == 1


def test_a_robot_without_a_place_has_no_pose() -> None:
    lost = LiveSurveyState(
        site="hall", recording="monday", stamp_ns=1, phase="tracking", seconds=0.0, frames=1, keyframes=0
    )
    found = shown(lost)
    assert "geometry_msgs/PoseWithCovarianceStamped" not in found
    assert CdrReader(found["std_msgs/String"]).text() == "tracking"
