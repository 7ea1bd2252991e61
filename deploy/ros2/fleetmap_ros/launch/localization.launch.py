"""Localization alone, in place of nav2_bringup's localization_launch.py."""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

CONFIG = f"{get_package_share_directory('fleetmap_ros')}/config/locclient.toml"


def generate_launch_description() -> LaunchDescription:
    """Arguments: config, a file of locclient's settings; autostart, false under a lifecycle manager."""
    localizer = Node(
        package="fleetmap_ros",
        executable="localizer",
        arguments=["--config", LaunchConfiguration("config")],
        parameters=[{"output.autostart": LaunchConfiguration("autostart")}],
        output="screen",
    )
    arguments = {"config": CONFIG, "autostart": "true"}
    declared = [DeclareLaunchArgument(name, default_value=value) for name, value in arguments.items()]
    return LaunchDescription([*declared, localizer])
