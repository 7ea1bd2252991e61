"""Replacement of nav2_bringup's localization_launch.py: the lifecycle manager. locclient is a separate service and publishes /map.

ros2 launch deploy/ros2/localization.launch.py params:=deploy/ros2/nav2_params.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Start the lifecycle manager with the parameters of a file."""
    lifecycle_manager = Node(
        package="nav2_lifecycle_manager",
        executable="lifecycle_manager",
        name="lifecycle_manager_localization",
        parameters=[LaunchConfiguration("params")],
    )
    return LaunchDescription([DeclareLaunchArgument("params"), lifecycle_manager])
