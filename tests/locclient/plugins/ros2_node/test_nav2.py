"""The daemon, and programs of ROS itself in other processes that know nothing of it: nav2's manager, operators, drivers."""

import signal
import subprocess
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import Array, rotation_from_quat_wxyz, se3, se3_inverse, so3_exp, so3_log
from fleetmap.recordings.ros2.messages import position_quat_xyzw
from support.recordings.recording_samples import calibration
from support.ros2.environment import needs_ros, ros_program
from support.ros2.peer import BEST_EFFORT, LATCHED, PATIENCE_S, POSE, TF, RosPeer, ros_peer
from support.waiting import eventually
from support.worlds import robot_world

pytestmark = [needs_ros, pytest.mark.timeout(600)]
NODE = "fleetmap_localizer"
DIAGNOSTICS = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
soon = partial(eventually, within_s=PATIENCE_S)
FRAME_NS = round(robot_world.FRAME_S * 1e9)


@contextmanager
def robot(
    folder: Path, frames: range, output: str, *, speed: float, name: str = "r1"
) -> Iterator[subprocess.Popen[str]]:
    """`locclient run` on a store's folder, with a ride that lasts."""
    path, walk = folder / f"{name}.toml", folder / f"walk{frames.start}"
    if not (folder / "store").exists():
        robot_world.stored(folder / "store", has_grid=True)
    if not walk.exists():
        robot_world.write(walk, islice(robot_world.bundles(frames.stop), frames.start, None))
    path.write_text(
        f'[run]\nstore = "{folder}/store"\nsite = "room"\nrobot = "{name}"\noutbox = "{folder}/{name}.sqlite3"\nframe_queue = 500\n'
        f'[source]\nkind = "recording"\nrecording = "{walk}"\nspeed = {speed}\n[output]\nformat = "ros2"\n{output}'
    )
    with ros_program("-m", "locclient.cli", "run", "--config", str(path)) as process:
        yield process


def diagnoses(peer: RosPeer, node: str = NODE) -> list[dict[str, Any]]:
    """Severity, message and values of all so far."""
    told = [status for message in peer.heard("/diagnostics") for status in message["status"]]
    return [
        {"severity": status["level"], "message": status["message"]} | {v["key"]: v["value"] for v in status["values"]}
        for status in told
        if status["name"].startswith(node)
    ]


def diagnosis(peer: RosPeer, node: str = NODE) -> dict[str, Any]:
    return [{"message": ""}, *diagnoses(peer, node)][-1]


def is_contradicted(peer: RosPeer, node: str, what: str) -> bool:
    """True if the node has said that another program publishes the same transform."""
    words = f"another program publishes {what} too"
    return any(words in told["message"] and told["severity"] == 2 for told in diagnoses(peer, node))


def beats(manager: RosPeer) -> list[bool]:
    """What the robot says on the bond: a subscriber receives its own messages too."""
    return [beat["active"] for beat in manager.heard("/bond") if beat["instance_id"] != "manager"]


def test_nav2_starts_it_asks_it_and_stops_it(tmp_path: Path) -> None:
    with (
        ros_peer("lifecycle_manager_localization") as manager,
        ros_peer("navigator") as navigator,
        robot(tmp_path, range(400), "autostart = false\n", speed=0.4) as process,
    ):

        def state() -> str:
            return manager.call(f"/{NODE}/get_state", "lifecycle_msgs/srv/GetState")["current_state"]["label"]

        def change(number: int, label: str = "") -> bool:
            transition = {"id": number, "label": label}
            kind = "lifecycle_msgs/srv/ChangeState"
            return manager.call(f"/{NODE}/change_state", kind, transition=transition)["success"]

        def bond(*, active: bool) -> None:
            said = {"id": NODE, "instance_id": "manager", "heartbeat_timeout": 4.0, "heartbeat_period": 0.1}
            manager.publish("/bond", "bond/msg/Status", active=active, **said)

        navigator.listen("/tf", TF)
        manager.listen("/bond", "bond/msg/Status")
        assert state() == "unconfigured"
        assert not change(3) and not change(99) and not change(0, "nonsense")
        assert not eventually(lambda: navigator.heard("/tf") or beats(manager), 1.0), "nothing before activation"
        assert change(1) and state() == "inactive" and change(3) and state() == "active"
        bond(active=True)
        assert soon(lambda: True in beats(manager))
        assert manager.newest("/bond")["heartbeat_period"] == pytest.approx(0.1)

        own = ["get_state", "change_state", "get_available_states", "get_available_transitions", "get_transition_graph"]
        services = [f"{NODE}/{name}" for name in (*own, "list_parameters", "set_parameters")]
        services += ["set_initial_pose", "reinitialize_global_localization", "request_nomotion_update"]
        wanted = {f"service /{name}" for name in services}
        wanted |= {f"publisher /{name}" for name in ("tf", "tf_static", "visual_odom", "map", "bond", "diagnostics")}
        wanted |= {f"subscription /{name}" for name in ("initialpose", "tf", "bond")}
        assert soon(lambda: wanted <= set(navigator.endpoints(NODE))), wanted - set(navigator.endpoints(NODE))

        assert soon(lambda: any(link[0] == "map" for link in links(navigator, "/tf")))
        late = {"/amcl_pose": POSE, "/map": "nav_msgs/msg/OccupancyGrid", "/tf_static": TF}
        for topic, kind in late.items():  # as BasicNavigator waits for a pose
            navigator.listen(topic, kind, **LATCHED)
        navigator.listen(*DIAGNOSTICS)
        navigator.listen("/visual_odom", "nav_msgs/msg/Odometry")
        assert soon(lambda: diagnosis(navigator)["message"] == "TRACKING")
        grid = navigator.newest("/map")
        assert {100, 0} <= set(grid["data"]) and grid["header"]["frame_id"] == "map"
        navigator.newest("/tf_static")
        static = links(navigator, "/tf_static")
        assert static[0][:2] == ("base_link", "fleetmap_body") and static[2][1] == "fleetmap_cam1_optical"
        assert navigator.newest("/visual_odom")["child_frame_id"] == "base_link"

        # An operator.
        def places_m() -> list[float]:
            return [told["pose"]["pose"]["position"]["x"] for told in navigator.heard("/amcl_pose")]

        given = navigator.newest("/amcl_pose")
        far = given["pose"] | {"covariance": [0.0] * 36}
        far["pose"]["position"]["x"] += 6.0
        far_m, bad = far["pose"]["position"]["x"], far | {"covariance": [-1.0, *[0.0] * 35]}
        for header, words in ((given["header"], "positive"), (given["header"] | {"frame_id": "odom"}, "frame 'odom'")):
            navigator.call("/set_initial_pose", "nav2_msgs/srv/SetInitialPose", pose={"header": header, "pose": bad})
            assert soon(lambda w=words: w in diagnosis(navigator).get("refused_initial_pose", ""))
        navigator.publish("/initialpose", POSE, raw=list(b"nonsense"))
        assert min(abs(x_m - far_m) for x_m in places_m()) > 3, "what was refused changes nothing"
        navigator.publish("/initialpose", POSE, header=given["header"], pose=far)
        assert soon(lambda: min(abs(x_m - far_m) for x_m in places_m()) < 1)
        navigator.call("/reinitialize_global_localization", "std_srvs/srv/Empty")
        assert soon(lambda: abs(places_m()[-1] - far_m) > 3 and diagnosis(navigator)["message"] == "TRACKING")
        assert soon(lambda: "refused_initial_pose" not in diagnosis(navigator))

        # `ros2 param`.
        names = navigator.call(f"/{NODE}/list_parameters", "rcl_interfaces/srv/ListParameters")["result"]["names"]
        assert {"output.publish_odom", "output.map_frame", "output.transform_tolerance_s"} <= set(names)
        results = []
        changes = [("map_frame", {"type": 4, "string_value": "site"}), ("transform_tolerance_s", {"type": 0})]
        tolerances = [{"type": 3, "double_value": seconds} for seconds in (-1.0, 61.0, float("nan"), 0.3)]
        for name, value in (*changes, *(("transform_tolerance_s", each) for each in tolerances)):
            parameters = [{"name": f"output.{name}", "value": value}]
            service = f"/{NODE}/set_parameters", "rcl_interfaces/srv/SetParameters"
            results += navigator.call(*service, parameters=parameters)["results"]
        assert [one["successful"] for one in results] == [False] * 5 + [True]
        assert "output.map_frame: it is read at the start" in results[0]["reason"]

        # Another subscriber than ROS connects with it, and another publisher of its transform.
        navigator.listen("/localization/status", "std_msgs/msg/String", **LATCHED)
        pair = "/localization/status: /navigator does not receive from /fleetmap_localizer: Volatile publisher"
        link = {"header": given["header"] | {"frame_id": "odom"}, "child_frame_id": "base_link"}
        navigator.publish("/tf", TF, transforms=[link])
        assert soon(lambda: pair in diagnosis(navigator)["message"])
        assert soon(lambda: is_contradicted(navigator, NODE, "odom -> base_link"))

        assert change(0, "deactivate") and state() == "inactive"
        assert soon(lambda: not beats(manager)[-1]), "the bond ends with the active state"
        assert change(3)
        assert soon(lambda: beats(manager)[-1])
        bond(active=False)
        assert soon(lambda: not beats(manager)[-1]), "the end is acknowledged"
        assert state() == "active"
        assert change(7) and state() == "finalized"
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
        assert soon(lambda: NODE not in manager.nodes())


def test_what_nodes_tell_of_their_map_of_a_building_of_a_stuck_robot_and_of_a_middleware_that_fails() -> None:
    """A topic that is remapped is so once, and gets what a best-effort publisher sends there."""
    remapped = ["--ros-args", "-r", "/initialpose:=/given", "-r", "/given:=/other"]
    with ros_program("-m", "support.ros2.scripted_localizer", *remapped) as process, ros_peer("navigator") as peer:
        peer.listen(*DIAGNOSTICS)
        peer.listen("/bond", "bond/msg/Status")
        peer.listen("/tf_static", TF, **LATCHED)
        peer.listen("/map", "nav_msgs/msg/OccupancyGrid", **LATCHED)
        assert soon(lambda: diagnosis(peer, "whole")["message"] == "TRACKING")
        told = {
            "map": "version 2 has no grid",
            "floor": "hall_2",
            "level": "2",
            "radius_95_m": "0.056",
            "protection_m": "0.250",
        }
        assert told.items() <= diagnosis(peer, "whole").items()
        assert peer.newest("/map")["info"]["width"] == 3, "the last grid stays"
        assert soon(lambda: ("building", "map") in [link[:2] for link in links(peer, "/tf_static")])

        assert soon(lambda: "publisher /attic/tf" in peer.endpoints("bare", "/attic"))
        assert "publisher /attic/map" not in peer.endpoints("bare", "/attic")
        assert soon(lambda: "stop: the protection level is above 0.2 m" in diagnosis(peer, "bare")["message"])
        peer.publish("/attic/tf", TF, transforms=[{"header": {"frame_id": "map"}, "child_frame_id": "odom"}])
        assert soon(lambda: is_contradicted(peer, "bare", "map -> odom"))

        peer.publish("/given", POSE, qos=BEST_EFFORT, header={"frame_id": "odom"})
        assert soon(lambda: "'odom'" in diagnosis(peer, "whole").get("refused_initial_pose", ""))
        assert "subscription /other" not in peer.endpoints("whole")

        def is_bonded(within_s: float = 2.0) -> bool:
            count = len(peer.heard("/bond"))
            return eventually(lambda: len(peer.heard("/bond")) > count, within_s)

        assert is_bonded(PATIENCE_S)
        print("stuck", file=process.stdin, flush=True)
        assert soon(lambda: not is_bonded())
        print("on", file=process.stdin, flush=True)
        assert is_bonded(PATIENCE_S)
        print("down", file=process.stdin, flush=True)
        assert [line.split(":")[0] for line in process.stdout] == ["ROS 2 did not send"] * 2
        assert process.wait(PATIENCE_S) == 0


LIVES = (range(110), range(110, 230))
RESET_FRAME, RESTART_FRAMES = 80, range(185, 198)


def driver_poses(truth: list[Array]) -> list[deque[tuple[int, Array]]]:
    """Stamps and odom_from_base of two runs of the driver: of the first the origin is reset once; the second starts at another one."""
    camera = calibration().cameras[0]
    begun_ns = int(robot_world.cycle().stamps_ns[0]) + round(camera.imu_minus_cam_s * 1e9)
    runs = [deque[tuple[int, Array]](), deque[tuple[int, Array]]()]
    begin = se3(so3_exp(np.array([0, 0, 1.0])), np.array([-40.0, 7.0, 0.0]))
    for number, (before, after) in enumerate(pairwise(truth)):
        turn, step_m = so3_log(before[:3, :3].T @ after[:3, :3]), after[:3, 3] - before[:3, 3]
        for step in range(5 * (number not in RESTART_FRAMES)):
            share = step / 5
            map_from_base = se3(before[:3, :3] @ so3_exp(share * turn), before[:3, 3] + share * step_m)
            run = int(number >= RESTART_FRAMES.stop)
            origin = truth[0] if run else truth[RESET_FRAME] if number + share > RESET_FRAME + 0.5 else begin
            runs[run].append((begun_ns + number * FRAME_NS + step * FRAME_NS // 5, se3_inverse(origin) @ map_from_base))
    return runs


def drive(driver: RosPeer, way: deque[tuple[int, Array]], until_ns: int) -> None:
    """Publish the driver's transforms up to then."""
    told = []
    while way and way[0][0] <= until_ns:
        stamp_ns, odom_from_base = way.popleft()
        values = position_quat_xyzw(odom_from_base).tolist()
        place, turn = (dict(zip("xyzw", part, strict=False)) for part in (values[:3], values[3:]))
        header = {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": "odom"}
        link = {"translation": place, "rotation": turn}
        told.append({"header": header, "child_frame_id": "base_link", "transform": link})
    if told:
        driver.publish("/wheels/tf", TF, transforms=told)


def links(peer: RosPeer, topic: str) -> list[tuple[str, str, int, Array]]:
    """Parent, child, stamp and parent_from_child (4, 4) of all transforms of a topic."""
    found = []
    for told in [told for message in peer.heard(topic) for told in message["transforms"]]:
        stamp, place, turn = told["header"]["stamp"], told["transform"]["translation"], told["transform"]["rotation"]
        rotation = rotation_from_quat_wxyz(np.array([turn[axis] for axis in "wxyz"]))
        parent_from_child = se3(rotation, np.array([place[axis] for axis in "xyz"]))
        stamp_ns = stamp["sec"] * 10**9 + stamp["nanosec"]
        found.append((told["header"]["frame_id"], told["child_frame_id"], stamp_ns, parent_from_child))
    return found


def test_the_tree_holds_the_true_pose_at_every_frame(tmp_path: Path) -> None:
    """Over two lives of the localizer, with its own odometry, and with a driver's, which is reset once and started again."""
    truth = [robot_world.truth(n) @ se3_inverse(calibration().base_from_body) for n in range(LIVES[-1].stop + 1)]
    is_own, runs = {"camera": True, "wheels": False}, driver_poses(truth)
    with ExitStack() as stack:
        listener, *drivers = [stack.enter_context(ros_peer(name)) for name in ("listener", "driver", "restarted")]
        listener.listen("/wheels/visual_odom", "nav_msgs/msg/Odometry")
        for name in is_own:
            listener.listen(f"/{name}/tf", TF)
        for driver in drivers:
            driver.publish("/wheels/tf", TF)
        for life in LIVES:
            with ExitStack() as alive:
                robots = []
                for name, is_publisher in is_own.items():
                    output = f'namespace = "{name}"\npublish_odom = {str(is_publisher).lower()}\n'
                    robots.append(alive.enter_context(robot(tmp_path, life, output, speed=2.0, name=name)))
                while any(process.poll() is None for process in robots):
                    stamp = listener.newest("/wheels/visual_odom")["header"]["stamp"]
                    for driver, way in zip(drivers, runs, strict=True):
                        drive(driver, way, stamp["sec"] * 10**9 + stamp["nanosec"] + 5 * FRAME_NS)
                    time.sleep(0.05)
                assert [process.returncode for process in robots] == [0, 0]
        sent = {name: links(listener, f"/{name}/tf") for name in is_own}
    begun_ns = int(robot_world.cycle().stamps_ns[0])
    for name, is_publisher in is_own.items():
        odom_from_base = {stamp_ns: link for _, child, stamp_ns, link in sent[name] if child == "base_link"}
        placed = {(ns - begun_ns) // FRAME_NS: (ns, link) for parent, _, ns, link in sent[name] if parent == "map"}
        for life in LIVES:
            first = min(set(placed) & set(life))
            assert first < life.start + 75, "ROS has connected all before the driver's pose is not known"
            unknown = {*RESTART_FRAMES, RESTART_FRAMES.start - 1} if not is_publisher else set()
            assert set(range(first, life.stop - 5)) - unknown <= set(placed)
        # ROS may lose a message on its way from the driver to the listener: of up to some frames' poses
        heard = {number: link for number, link in placed.items() if link[0] in odom_from_base}
        assert len(heard) >= len(placed) - (0 if is_publisher else 5)
        for number, (stamp_ns, map_from_odom) in heard.items():
            error_m = (map_from_odom @ odom_from_base[stamp_ns])[:3, 3] - truth[number][:3, 3]
            assert np.linalg.norm(error_m) < 0.025, (name, number)
