"""Estimates on the topics of the node, and what its section and that of the source must hold."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetmap.geometry import se3, se3_inverse, so3_exp
from fleetmap.messages import Status
from fleetmap.recordings.ros2.cdr import unpack
from fleetmap.recordings.ros2.messages import decode_frame_links, decode_prior
from fleetmap.sensors.source_settings import SourceSection, Topics
from fleetmap.sources.source import open_source
from locclient.daemon.publishers import output_of
from locclient.outputs import OutputSection
from locclient.plugins.ros2_node.keys import RmwZenohKeys
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.estimates import BASE_FROM_BODY, estimate, inputs, published
from support.fleet.memory_bus import MemoryBus, MemoryHub


def test_a_source_of_topics_needs_a_calibration() -> None:
    with pytest.raises(UsageError, match="camchain"):
        open_source(SourceSection(), Topics())


def test_ros_topics_hold_the_same() -> None:
    tracked = estimate(5.0, x_m=2.0, sigma_m=0.1)
    told = published(OutputSection(format="ros2", domain=3), tracked, estimate(6.0, Status.LOST, known=False))
    expected = tracked.map_from_body @ se3_inverse(BASE_FROM_BODY)
    stamped = told[RmwZenohKeys(3).key("/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped")]
    assert len(stamped) == 1
    prior = decode_prior(stamped[0])
    np.testing.assert_allclose(prior.map_from_base, expected, atol=1e-12)
    levers_m2 = np.array([0.2**2 + 0.5**2, 0.5**2, 0.2**2])  # of the base about the body, which is turned by 90 degrees
    np.testing.assert_allclose(np.diag(prior.cov_rot_trans), [*[1e-4] * 3, *(0.01 + 1e-4 * levers_m2)])
    links = [
        link
        for payload in told[RmwZenohKeys(3).key("/tf", "tf2_msgs/TFMessage")]
        for link in decode_frame_links(payload)
    ]
    assert [(link.parent, link.child) for link in links] == [("map", "odom"), *[("odom", "base_link")] * 2]
    np.testing.assert_allclose(links[0].parent_from_child @ links[1].parent_from_child, expected, atol=1e-12)
    states = told[RmwZenohKeys(3).key("/localization/status", "std_msgs/String")]
    assert [unpack("std_msgs/String", state) for state in states] == [["TRACKING"], ["LOST"]]


def test_the_building_is_told_once_the_map_says_it() -> None:
    """Beside the cameras' frames, in one message: late subscribers get the last one alone. Not again with every frame."""
    building_from_map = se3(so3_exp(np.array([0.0, 0.0, 0.5])), np.array([3.0, -4.0, 0.0]))
    section = OutputSection(format="ros2", building_frame="building")
    hub, heard = MemoryHub(), []
    key = RmwZenohKeys(0).key("/tf_static", "tf2_msgs/TFMessage")
    with MemoryBus(hub) as bus, MemoryBus(hub) as other:
        other.subscribe(key, lambda _, payload: heard.append(decode_frame_links(payload)))
        publisher = output_of(section).open(section, *inputs(bus))
        odom = ContinuousOdom(BASE_FROM_BODY)
        for known in (None, building_from_map, building_from_map.copy(), None):
            one = estimate(5.0)
            placed = replace(odom.handle(one), building_from_map=known)
            publisher.publish(one, placed, BASE_FROM_BODY)  # type: ignore[arg-type]
        publisher.close()
    assert [len(links) for links in heard] == [3, 4]
    assert (heard[1][3].parent, heard[1][3].child) == ("building", "map")
    np.testing.assert_allclose(heard[1][3].parent_from_child, building_from_map, atol=1e-12)
    told = published(OutputSection(format="ros2"), estimate(5.0))
    assert [len(decode_frame_links(payload)) for payload in told[key]] == [3]
