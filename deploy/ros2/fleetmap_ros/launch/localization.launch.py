"""Localization alone, in place of nav2_bringup's localization_launch.py: the node, and RViz where it is asked for.

ros2 launch fleetmap_ros localization.launch.py config:=/etc/fleetmap/locclient.toml
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

SHARE = Path(get_package_share_directory("fleetmap_ros"))


def generate_launch_description() -> LaunchDescription:
    """Arguments: config, a file of locclient's settings; autostart, false under a lifecycle manager; namespace; rviz."""
    arguments = {
        "config": str(SHARE / "config/locclient.toml"),
        "autostart": "true",
        "namespace": "",
        "rviz": "false",
    }
    localizer = Node(
        package="fleetmap_ros",
        executable="localizer",
        namespace=LaunchConfiguration("namespace"),
        arguments=["--config", LaunchConfiguration("config")],
        parameters=[{"output.autostart": ParameterValue(LaunchConfiguration("autostart"), value_type=bool)}],
        output="screen",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),
        arguments=["-d", str(SHARE / "rviz/localization.rviz")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    declared = [DeclareLaunchArgument(name, default_value=value) for name, value in arguments.items()]
    return LaunchDescription([*declared, localizer, rviz])
