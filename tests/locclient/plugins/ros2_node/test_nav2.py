"""The daemon, and programs of ROS itself in other processes that know nothing of it: nav2's manager, operators, drivers."""

import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import Array, rotation_from_quat_wxyz, se3, se3_inverse, so3_exp, so3_log
from fleetmap.recordings.ros2.messages import FrameLink, position_quat_xyzw
from mapserver.store import MapStore
from support.recordings.recording_samples import calibration
from support.ros2.environment import needs_ros, ros_program
from support.ros2.peer import (
    ACTIVE,
    FINALIZED,
    INACTIVE,
    PATIENCE_S,
    POSE,
    UNCONFIGURED,
    RosPeer,
    lifecycle_manager,
    ros_peer,
)
from support.waiting import eventually
from support.worlds import robot_world

pytestmark = [needs_ros, pytest.mark.timeout(600)]
NODE = "fleetmap_localizer"
LATCHED = {"durability": "TRANSIENT_LOCAL"}


@contextmanager
def robot(folder: Path, frames: range, *, output: str = "", speed: float = 0.4) -> Iterator[subprocess.Popen[str]]:
    """`locclient run` on a store's folder, with a ride that lasts."""
    if not (folder / "store").exists():
        with MapStore.open(folder / "store", create=True) as store:
            robot_world.save(store, has_grid=True)
    path = folder / "robot.toml"
    walk = robot_world.write(
        folder / f"walk{frames.start}", islice(robot_world.bundles(frames.stop), frames.start, None)
    )
    path.write_text(
        f'[run]\nstore = "{folder}/store"\nsite = "room"\nrobot = "r1"\noutbox = "{folder}/spool.sqlite3"\nframe_queue = 500\n'
        f'[source]\nkind = "recording"\nrecording = "{walk}"\nspeed = {speed}\n[output]\nformat = "ros2"\n{output}'
    )
    with ros_program("-m", "locclient.cli", "run", "--config", str(path)) as process:
        yield process


def diagnosis(peer: RosPeer) -> dict[str, Any]:
    """The newest one's level, message and values."""
    (status,) = (peer.heard("/diagnostics") or [{"status": [{"level": 9, "message": "", "values": []}]}])[-1]["status"]
    return {"level": status["level"], "message": status["message"], **{v["key"]: v["value"] for v in status["values"]}}


def pose_at(peer: RosPeer) -> float:
    return float(
        (peer.heard("/amcl_pose") or [{"pose": {"pose": {"position": {"x": np.nan}}}}])[-1]["pose"]["pose"]["position"][
            "x"
        ]
    )


def test_nav2_starts_it_asks_it_and_stops_it(tmp_path: Path) -> None:
    with (
        lifecycle_manager(NODE) as manager,
        ros_peer("navigator") as navigator,
        robot(tmp_path, range(400), output="autostart = false\n") as process,
    ):
        navigator.listen("/tf", "tf2_msgs/msg/TFMessage")
        assert manager.state() == UNCONFIGURED
        assert not manager.change(3) and not manager.change(99) and not manager.change(0, "nonsense")
        assert not eventually(lambda: bool(navigator.heard("/tf")), 1.0), "nothing is told before activation"
        assert manager.startup()
        assert manager.beats()[-1]["heartbeat_period"] == pytest.approx(0.1)

        services = ["change_state", "get_available_states", "get_available_transitions", "get_transition_graph"]
        services = [f"/{NODE}/{name}" for name in (*services, "get_state", "list_parameters", "set_parameters")]
        services += ["/set_initial_pose", "/reinitialize_global_localization", "/request_nomotion_update"]
        published = ["/tf", "/tf_static", "/amcl_pose", "/visual_odom", "/map", "/bond", "/diagnostics"]
        wanted = {"services": services, "publishers": published, "subscriptions": ["/initialpose", "/tf", "/bond"]}

        def missing() -> list[str]:
            own = navigator.endpoints(NODE)
            return [name for kind, names in wanted.items() for name in names if name not in own[kind]]

        assert eventually(lambda: not missing(), PATIENCE_S), missing()

        def is_placed() -> bool:
            return any(
                link["header"]["frame_id"] == "map" for told in navigator.heard("/tf") for link in told["transforms"]
            )

        assert eventually(is_placed, PATIENCE_S)
        for topic, kind in (
            ("/amcl_pose", POSE),
            ("/map", "nav_msgs/msg/OccupancyGrid"),
            ("/tf_static", "tf2_msgs/msg/TFMessage"),
        ):
            navigator.listen(topic, kind, **LATCHED)  # late: BasicNavigator waits for a pose
        navigator.listen("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        navigator.listen("/visual_odom", "nav_msgs/msg/Odometry")
        assert eventually(lambda: diagnosis(navigator)["message"] == "TRACKING", PATIENCE_S)
        grid = navigator.newest("/map")
        assert {100, 0} <= set(grid["data"]) and grid["header"]["frame_id"] == "map"
        static = navigator.newest("/tf_static")
        found = [(link["header"]["frame_id"], link["child_frame_id"]) for link in static["transforms"]]
        assert found[0] == ("base_link", "fleetmap_body") and found[2][1] == "fleetmap_cam1_optical"
        assert navigator.newest("/visual_odom")["child_frame_id"] == "base_link"

        # An operator.
        given = navigator.newest("/amcl_pose")
        far = given["pose"] | {"covariance": [0.0] * 36}
        far["pose"]["position"]["x"] += 6.0
        bad = far | {"covariance": [-1.0, *[0.0] * 35]}
        for topic, words in ((given["header"], "positive"), (given["header"] | {"frame_id": "odom"}, "frame 'odom'")):
            navigator.call("/set_initial_pose", "nav2_msgs/srv/SetInitialPose", pose={"header": topic, "pose": bad})
            assert eventually(lambda w=words: w in diagnosis(navigator).get("refused_initial_pose", ""), PATIENCE_S)
        navigator.publish("/initialpose", POSE, raw=list(b"nonsense"))
        assert abs(pose_at(navigator) - far["pose"]["position"]["x"]) > 3, "what was refused changes nothing"
        navigator.publish("/initialpose", POSE, header=given["header"], pose=far)
        assert eventually(lambda: abs(pose_at(navigator) - far["pose"]["position"]["x"]) < 1, PATIENCE_S)
        navigator.call("/reinitialize_global_localization", "std_srvs/srv/Empty")
        at_m = far["pose"]["position"]["x"]
        assert eventually(
            lambda: diagnosis(navigator)["message"] == "TRACKING" and abs(pose_at(navigator) - at_m) > 3, PATIENCE_S
        )
        assert eventually(lambda: "refused_initial_pose" not in diagnosis(navigator), PATIENCE_S)

        # `ros2 param`.
        names = navigator.call(f"/{NODE}/list_parameters", "rcl_interfaces/srv/ListParameters")["result"]["names"]
        assert {"output.publish_odom", "output.map_frame", "output.transform_tolerance_s"} <= set(names)
        results = []
        for name, value in (
            ("map_frame", {"type": 4, "string_value": "site"}),
            ("transform_tolerance_s", {"type": 0}),
            ("transform_tolerance_s", {"type": 3, "double_value": -1.0}),
            ("transform_tolerance_s", {"type": 3, "double_value": 0.3}),
        ):
            change = [{"name": f"output.{name}", "value": value}]
            results += navigator.call(f"/{NODE}/set_parameters", "rcl_interfaces/srv/SetParameters", parameters=change)[
                "results"
            ]
        assert [one["successful"] for one in results] == [False, False, False, True]
        assert "output.map_frame: it is read at the start" in results[0]["reason"]

        # Another subscriber than ROS connects with it.
        navigator.listen("/localization/status", "std_msgs/msg/String", **LATCHED)
        pair = "/localization/status: navigator does not receive from fleetmap_localizer: Volatile publisher"
        assert eventually(lambda: pair in diagnosis(navigator)["message"], PATIENCE_S)

        link = {"header": given["header"] | {"frame_id": "odom"}, "child_frame_id": "base_link"}
        navigator.publish("/tf", "tf2_msgs/msg/TFMessage", transforms=[link])
        other = "another program publishes odom -> base_link too"
        assert eventually(
            lambda: other in diagnosis(navigator)["message"] and diagnosis(navigator)["level"] == 2, PATIENCE_S
        )

        assert manager.change(0, "deactivate") and manager.state() == INACTIVE
        assert eventually(lambda: not manager.beats()[-1]["active"], PATIENCE_S), "the bond ends with the active state"
        assert manager.change(3)
        assert eventually(lambda: manager.beats()[-1]["active"], PATIENCE_S)
        manager.tell_bond(active=False)
        assert eventually(lambda: not manager.beats()[-1]["active"], PATIENCE_S), "the end is acknowledged"
        assert manager.state() == ACTIVE
        assert manager.change(7) and manager.state() == FINALIZED
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
        assert eventually(lambda: NODE not in manager.nodes(), PATIENCE_S)


LIVES = (range(110), range(110, 230))
RESET_FRAME, RESTART_FRAMES = 80, range(185, 198)


def driver_poses(truth: list[Array]) -> list[list[tuple[int, list[float]]]]:
    """Stamps and odom_from_base of two runs of the driver: of the first the origin is reset once; the second starts at another one."""
    camera, frame_ns = calibration().cameras[0], round(robot_world.FRAME_S * 1e9)
    begun_ns = int(robot_world.cycle().stamps_ns[0]) + round(camera.imu_minus_cam_s * 1e9)
    runs: list[list[tuple[int, list[float]]]] = [[], []]
    for number, (before, after) in enumerate(pairwise(truth)):
        turn = so3_log(before[:3, :3].T @ after[:3, :3])
        for step in range(5):
            share = step / 5
            map_from_base = se3(
                before[:3, :3] @ so3_exp(share * turn), (1 - share) * before[:3, 3] + share * after[:3, 3]
            )
            run, origin = (
                int(number >= RESTART_FRAMES.stop),
                se3(so3_exp(np.array([0, 0, 1.0])), np.array([-40.0, 7.0, 0.0])),
            )
            if run:
                origin = truth[0]
            elif number > RESET_FRAME or (number == RESET_FRAME and step > 2):
                origin = truth[RESET_FRAME]
            if number not in RESTART_FRAMES:
                stamp_ns = begun_ns + number * frame_ns + step * frame_ns // 5
                runs[run].append((stamp_ns, position_quat_xyzw(se3_inverse(origin) @ map_from_base).tolist()))
    return runs


@pytest.mark.parametrize("publish_odom", [True, False])
def test_the_tree_holds_the_true_pose_at_every_frame(tmp_path: Path, publish_odom: bool) -> None:
    """Over two lives of the localizer, a reset of the driver's odometry, and a restart of the driver."""
    truth = [robot_world.truth(n) @ se3_inverse(calibration().base_from_body) for n in range(LIVES[-1].stop + 1)]
    with ros_peer("listener") as listener, ExitStack() as drivers:
        listener.listen("/tf", "tf2_msgs/msg/TFMessage")
        for number, run in enumerate(driver_poses(truth) if not publish_odom else []):
            (tmp_path / f"poses{number}.json").write_text(json.dumps(run))
            drivers.enter_context(ros_program("-m", "support.ros2.wheel_driver", str(tmp_path / f"poses{number}.json")))
        for life in LIVES:
            settings = f"publish_odom = {str(publish_odom).lower()}\n"
            with robot(tmp_path, life, output=settings, speed=1.0) as process:
                assert process.wait(120) == 0
        links = [link_of(told) for message in listener.heard("/tf") for told in message["transforms"]]
    begun_ns, frame_ns = int(robot_world.cycle().stamps_ns[0]), round(robot_world.FRAME_S * 1e9)
    place_of = {link.stamp_ns: link.parent_from_child for link in links if link.child == "base_link"}
    placed = [((link.stamp_ns - begun_ns) // frame_ns, link) for link in links if link.parent == "map"]
    wanted = {
        n for life in LIVES for n in life[50:] if publish_odom or n not in (RESTART_FRAMES.start - 1, *RESTART_FRAMES)
    }
    assert wanted <= {number for number, _ in placed}, "once ROS has connected all, if the driver's pose is known"
    for number, link in placed:
        error_m = (link.parent_from_child @ place_of[link.stamp_ns])[:3, 3] - truth[number][:3, 3]
        assert np.linalg.norm(error_m) < 0.025, number


def link_of(told: dict[str, Any]) -> FrameLink:
    stamp, place, turn = told["header"]["stamp"], told["transform"]["translation"], told["transform"]["rotation"]
    rotation = rotation_from_quat_wxyz(np.array([turn[axis] for axis in "wxyz"]))
    parent_from_child = se3(rotation, np.array([place[axis] for axis in "xyz"]))
    return FrameLink(
        told["header"]["frame_id"], told["child_frame_id"], parent_from_child, stamp["sec"] * 10**9 + stamp["nanosec"]
    )
