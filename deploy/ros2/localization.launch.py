"""In the place of nav2_bringup's localization_launch.py: map_server and the lifecycle manager; locclient is a service of its own.

ros2 launch deploy/ros2/localization.launch.py params:=deploy/ros2/nav2_params.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Starts both with the parameters of one file."""
    params = LaunchConfiguration("params")
    lifecycle_manager = Node(
        package="nav2_lifecycle_manager",
        executable="lifecycle_manager",
        name="lifecycle_manager_localization",
        parameters=[params],
    )
    map_server = Node(package="nav2_map_server", executable="map_server", name="map_server", parameters=[params])
    return LaunchDescription([DeclareLaunchArgument("params"), map_server, lifecycle_manager])
