"""Outputs of a robot whose estimates are made up, two nodes: `python -m support.ros2.scripted_localizer [ARGUMENTS OF ROS]`.

Every fiftieth look at ROS's graph fails. A line "stuck" on its standard input stops them until the next line; "down" ends ROS 2 below
them, and prints what they say to that.
"""

import select
import sys
import time
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.utilities import get_default_context

from fleetmap.errors import LinkError
from fleetmap.geometry import se3
from fleetmap.sources.intake import Intake
from fleetmap.version_grid import OccupancyGrid
from locclient.outputs import OutputSection
from locclient.plugins.ros2_node import OUTPUT
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.estimates import estimate
from support.recordings.recording_samples import calibration

BUILDING_FROM_MAP = se3(np.eye(3), np.array([40.0, 0.0, 0.0]))
SECTIONS = (
    OutputSection(format="ros2", node="whole", building_frame="building"),
    OutputSection(format="ros2", node="bare", namespace="attic", map_topic="", publish_odom=False, stop_above_m=0.2),
)


def main() -> None:
    rclpy.init(args=sys.argv)
    intake, odom = Intake(frames=1, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0), ContinuousOdom(np.eye(4))
    localizers = [OUTPUT.open(section, None, "hall", "r1", calibration(), intake) for section in SECTIONS]
    for localizer in localizers:
        localizer.show_grid(1, OccupancyGrid(np.full((2, 3), 100, np.int8), 0.05, np.eye(4)), "")
        localizer.show_grid(2, None, "version 2 has no grid")
    look, calls = Node.get_publishers_info_by_topic, count(1)

    def failing_look(node: Node, topic: str) -> Any:
        if next(calls) % 50 == 0:
            raise rclpy_implementation.RCLError("the graph")
        return look(node, topic)

    Node.get_publishers_info_by_topic = failing_look
    word = ""
    while word != "down":
        told = replace(estimate(time.time()), floor="hall_2", protection_m=0.25)
        published = odom.handle(told)._replace(building_from_map=BUILDING_FROM_MAP, level="2")
        for localizer in localizers:
            localizer.publish(told, published, np.eye(4))
            localizer.alive(False)
        if select.select([sys.stdin], [], [], 0.1)[0]:
            word = sys.stdin.readline().strip()
        if word == "stuck":
            word = sys.stdin.readline().strip()
    get_default_context().handle.shutdown()
    for localizer in localizers:
        try:
            localizer.publish(told, published, np.eye(4))
        except LinkError as error:
            print(error, flush=True)
        localizer.close()


if __name__ == "__main__":
    main()
