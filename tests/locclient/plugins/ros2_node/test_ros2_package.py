"""The package `fleetmap_ros`: built by colcon, its parameters read by ROS, its launch files loaded.

ROS's own launch is in no wheel: stand-ins for its actions are called, and what they were called with is checked.
"""

import json
import re
import runpy
import shlex
import subprocess
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
import yaml

from locclient.config import read_config
from mapserver.store import MapStore
from mapserver.trust import init_here
from support.fleet.contracts_documents import REPOSITORY
from support.recordings.recording_samples import kalibr_text
from support.ros2.environment import needs_ros, ros_environment, ros_program
from support.ros2.peer import PATIENCE_S, ros_peer
from support.storage.map_samples import publish_samples
from support.waiting import eventually

PACKAGE = REPOSITORY / "deploy/ros2/fleetmap_ros"
NAV2 = Path("/nav2_bringup")  # whose files ROS has
PARAMETERS = PACKAGE / "config/nav2_params.yaml"
# Declared by nav2's nodes with these types; rclcpp ends a node whose parameter has another, also 4 for 4.0.
NAV2_TYPES = {"autostart": bool, "bond_timeout": float, "node_names": list, "global_frame": str, "odom_topic": str}
REFUSED = {
    "-p output.odom_topic:=/odom": "the robot would take its own odometry for that of its wheels",
    "-r visual_odom:=/odom": "the robot would take its own odometry for that of its wheels",
    "-p output.node:=place": "output.node = 'place' as a parameter of ROS comes too late",
    "-p output.map_frame:=base_link": "three different names",
    "-p output.pose_topic:=1st": "ROS 2 does not start: ",
}
# What rcl makes of the file `sys.argv[1]` for nodes, NAMESPACE/NAME.
READER = """
import json, sys, rclpy
rclpy.init(args=["--ros-args", "--params-file", sys.argv[1]])
for full in sys.argv[2:]:
    namespace, _, name = full.rpartition("/")
    node = rclpy.create_node(name, namespace=namespace, automatically_declare_parameters_from_overrides=True)
    print(json.dumps({name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}))
"""
# The package's program under each of the words in `sys.argv`, and its exit status, in one process.
PROGRAM = """
import sys, rclpy
from fleetmap_ros import main
for words in sys.argv[1:]:
    sys.argv[1:] = ["--config", "locclient.toml", "--ros-args", *words.split()]
    try:
        main()
    except SystemExit as end:
        print("exit", end.code, file=sys.stderr, flush=True)
    rclpy.try_shutdown()
"""


@needs_ros
def test_colcon_builds_a_program_that_leaves_arguments_of_ros_to_rclpy(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "colcon", "build", "--base-paths", str(PACKAGE)]
    subprocess.run(build, cwd=tmp_path, env=ros_environment(), check=True, capture_output=True)
    built = tmp_path / "install/fleetmap_ros"
    for folder in ("config", "launch", "rviz"):
        files = [path.name for path in sorted((built / "share/fleetmap_ros" / folder).iterdir())]
        assert files == [path.name for path in sorted((PACKAGE / folder).iterdir())]
    with MapStore.open(tmp_path / "store", create=True) as store:
        publish_samples(store, 1)
        init_here(store)
    (tmp_path / "rig.yaml").write_text(kalibr_text())
    settings = (PACKAGE / "config/locclient.toml").read_text()
    for name, value in {"identity": "store", "outbox": "outbox", "cache": "cache", "calibration": "rig.yaml"}.items():
        settings = re.sub(f"^{name} = .*$", f'{name} = "{value}"', settings, flags=re.MULTILINE)
    settings = settings.replace("identity =", 'site = "lab"\nrobot = "r1"\nstore =')
    (tmp_path / "locclient.toml").write_text(f'{settings}namespace = "r1"\n')

    def installed(command: str) -> subprocess.Popen[str]:
        environment = ros_environment() | {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin"}
        words = ["sh", "-c", f". install/setup.sh && exec {command}"]
        return subprocess.Popen(words, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True)

    with installed(f"{sys.executable} -c {shlex.quote(PROGRAM)} {shlex.join(REFUSED)}") as refused:
        told = refused.communicate(timeout=PATIENCE_S)[1].split("exit 2\n")
    assert (told.pop(), refused.returncode) == ("", 0), told
    assert all(reason in each for reason, each in zip(REFUSED.values(), told, strict=True)), told
    localizer = f"{built}/lib/fleetmap_ros/localizer --config locclient.toml"
    with (
        installed(f"{localizer} --ros-args -r __node:=place -p output.autostart:=false") as running,
        ExitStack() as stack,
        ros_peer("lifecycle_manager_localization") as manager,
    ):
        stack.callback(running.terminate)
        state = manager.call("/r1/place/get_state", "lifecycle_msgs/srv/GetState")["current_state"]
        assert state["label"] == "unconfigured"
        assert eventually(lambda: "subscription /imu0" in manager.endpoints("fleetmap_sensors", "/r1"), PATIENCE_S)
        manager.listen("/r1/amcl_pose", "std_msgs/msg/String")
        manager.listen("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        silent = "no frames come; /r1/amcl_pose: /lifecycle_manager_localization does not receive from /r1/place: it is geometry_msgs"
        unsent = "; /cam0/image_raw: nobody publishes it, as sensor_msgs/msg/Image; "
        told = partial(manager.heard, "/diagnostics")
        assert eventually(lambda: any(silent in str(each) and unsent in str(each) for each in told()), PATIENCE_S)


def launched(name: str, monkeypatch: pytest.MonkeyPatch) -> tuple[MagicMock, dict[str, str]]:
    """A stand-in for all actions, after a launch file was loaded and described, and its arguments with their defaults."""
    launch = MagicMock(PythonLaunchDescriptionSource=Path)
    launch.get_package_share_directory = {"fleetmap_ros": str(PACKAGE), "nav2_bringup": str(NAV2)}.get
    file = PACKAGE / "launch" / name
    for module in re.findall(r"^from ((?:launch|ament_index_python)\S*) import", file.read_text(), re.MULTILINE):
        monkeypatch.setitem(sys.modules, module.partition(".")[0], launch)
        monkeypatch.setitem(sys.modules, module, launch)
    runpy.run_path(str(file))["generate_launch_description"]()
    declared = [(call.args[0], call.kwargs["default_value"]) for call in launch.DeclareLaunchArgument.call_args_list]
    return launch, dict(declared)


def test_launch_files_name_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    alone, arguments = launched("localization.launch.py", monkeypatch)
    with_nav2, arguments_with_nav2 = launched("nav2.launch.py", monkeypatch)
    for launch, declared in ((alone, arguments), (with_nav2, arguments_with_nav2)):
        assert {call.args[0] for call in launch.LaunchConfiguration.call_args_list} == set(declared)
        files = [Path(value) for value in declared.values() if "/" in value]
        assert all(path.exists() or path.is_relative_to(NAV2) for path in files)
    (localizer,) = (call.kwargs for call in alone.Node.call_args_list)
    assert f'"{localizer["executable"]} = ' in (PACKAGE / "setup.py").read_text()
    ours, nav2 = with_nav2.IncludeLaunchDescription.call_args_list
    assert set(dict(ours.kwargs["launch_arguments"])) <= set(arguments)
    assert ours.args[0].exists() and nav2.args[0] == NAV2 / "launch/navigation_launch.py"
    (manager,) = (call.kwargs for call in with_nav2.Node.call_args_list)
    assert manager["parameters"] == [str(PARAMETERS)]
    parameters = yaml.safe_load(PARAMETERS.read_text())
    config, _ = read_config(PACKAGE / "config/locclient.toml", {})
    assert parameters[manager["name"]]["ros__parameters"]["node_names"] == [config.output.node]
    # One publisher of /map: the node, not nav2's map_server.
    assert config.output.map_topic == "map" and "map_server" not in parameters


@needs_ros
def test_ros_reads_the_parameters_with_the_types_that_nav2_declares() -> None:
    nodes = []
    for name, content in yaml.safe_load(PARAMETERS.read_text()).items():
        nodes += [f"/{name}"] if "ros__parameters" in content else [f"/{name}/{inner}" for inner in content]
    with ros_program("-c", READER, str(PARAMETERS), *nodes) as reader:
        read: list[dict[str, Any]] = [json.loads(line) for line in reader.communicate(timeout=60)[0].splitlines()]
    of_every_node = {"use_sim_time", "start_type_description_service"}
    types = [{name: type(value) for name, value in values.items() if name not in of_every_node} for values in read]
    assert len(types) == len(nodes) and all(types)
    assert {name: kind for of_node in types for name, kind in of_node.items()} == NAV2_TYPES
