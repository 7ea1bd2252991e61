"""Localization and nav2's navigation, in place of nav2_bringup's bringup_launch.py: the node, its lifecycle manager, and navigation.

ros2 launch fleetmap_ros nav2.launch.py config:=/etc/fleetmap/locclient.toml params_file:=YOUR_PARAMS.yaml
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

SHARE = Path(get_package_share_directory("fleetmap_ros"))
NAV2 = Path(get_package_share_directory("nav2_bringup"))


def generate_launch_description() -> LaunchDescription:
    """Arguments: config, a file of locclient's settings; params_file, the parameters of nav2's navigation; rviz."""
    arguments = {
        "config": str(SHARE / "config/locclient.toml"),
        "params_file": str(NAV2 / "params/nav2_params.yaml"),
        "rviz": "false",
    }
    localization = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(SHARE / "launch/localization.launch.py")),
        launch_arguments={
            "config": LaunchConfiguration("config"),
            "autostart": "false",
            "rviz": LaunchConfiguration("rviz"),
        }.items(),
    )
    lifecycle_manager = Node(
        package="nav2_lifecycle_manager",
        executable="lifecycle_manager",
        name="lifecycle_manager_localization",
        parameters=[str(SHARE / "config/nav2_params.yaml")],
    )
    navigation = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(NAV2 / "launch/navigation_launch.py")),
        launch_arguments={"params_file": LaunchConfiguration("params_file")}.items(),
    )
    declared = [DeclareLaunchArgument(name, default_value=value) for name, value in arguments.items()]
    return LaunchDescription([*declared, localization, lifecycle_manager, navigation])
