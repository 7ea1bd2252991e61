"""Localization and nav2's navigation, in place of nav2_bringup's bringup_launch.py: the node, its lifecycle manager, and navigation."""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

SHARE, NAV2 = (get_package_share_directory(name) for name in ("fleetmap_ros", "nav2_bringup"))


def _included(file: str, **arguments: object) -> IncludeLaunchDescription:
    return IncludeLaunchDescription(PythonLaunchDescriptionSource(file), launch_arguments=arguments.items())


def generate_launch_description() -> LaunchDescription:
    """Arguments: config, a file of locclient's settings; params_file, the parameters of nav2's navigation."""
    lifecycle_manager = Node(
        package="nav2_lifecycle_manager",
        executable="lifecycle_manager",
        name="lifecycle_manager_localization",
        parameters=[f"{SHARE}/config/nav2_params.yaml"],
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", default_value=f"{SHARE}/config/locclient.toml"),
            DeclareLaunchArgument("params_file", default_value=f"{NAV2}/params/nav2_params.yaml"),
            _included(
                f"{SHARE}/launch/localization.launch.py", config=LaunchConfiguration("config"), autostart="false"
            ),
            lifecycle_manager,
            _included(f"{NAV2}/launch/navigation_launch.py", params_file=LaunchConfiguration("params_file")),
        ]
    )
