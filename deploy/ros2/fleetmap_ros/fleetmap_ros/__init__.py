"""Starts the localization client of fleetmap: `locclient run` under the arguments that `ros2 run` and launch files add for ROS."""

import sys

from rclpy.utilities import remove_ros_args

from fleetmap.cli_exit import run_cli
from locclient.cli import app


def main() -> None:
    """Run `locclient run` with the arguments that are not ROS's. rclpy reads names, remappings and parameters from the others itself."""
    words = remove_ros_args(sys.argv)[1:]
    run_cli(lambda: app(["run", *words]))
