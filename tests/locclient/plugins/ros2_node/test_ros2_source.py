"""Sensors of ROS itself: drivers of rclpy in other processes, which send to those whom the graph shows as subscribers."""

import json
import signal
import subprocess
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fleetmap.errors import UsageError
from fleetmap.recordings import Topics, open_recording
from fleetmap.recordings.calibration_files import format_calibration
from fleetmap.sensors.source_settings import SourceSection
from fleetmap.sources.source import open_source
from locclient.outputs import OutputSection
from locclient.plugins.ros2_node import OUTPUT
from support.fleet.contracts_documents import REPOSITORY
from support.recordings.recording_samples import calibration
from support.ros2.environment import needs_ros, ros_program
from support.waiting import eventually

driver = partial(ros_program, "-m", "support.ros2.camera_driver")


def begin(camera: subprocess.Popen[str], **options: Any) -> None:
    print(json.dumps(options), file=camera.stdin, flush=True)
    assert camera.stdout.readline() == "sending\n"


@needs_ros
def test_all_frames_of_drivers_arrive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one that was started before the robot, and of those that take its place, the same and other ones."""
    lossy, profile = {"is_best_effort": True}, REPOSITORY / "deploy/ros2/fleetmap_ros/config/fastdds.xml"
    drives = [lossy, lossy, {"is_compressed": True, "has_imu": True}, {"is_compressed": True, "has_imu": True}, {}, {}]
    (tmp_path / "rig.yaml").write_text(format_calibration(calibration()))
    with ExitStack() as stack:
        cameras = []
        for options in drives:
            with monkeypatch.context() as patch:
                if options is lossy:
                    patch.setenv("FASTDDS_DEFAULT_PROFILES_FILE", str(profile))
                cameras.append(stack.enter_context(driver()))
        begin(cameras[0], frames=30, **drives[0])
        robot = stack.enter_context(ros_program("-m", "support.ros2.sensor_listener", str(tmp_path / "rig.yaml")))
        figures, sent = {"frames": 0}, 0
        for camera, options in zip(cameras, drives, strict=True):
            if camera is not cameras[0]:
                begin(camera, frames=30, **options)
            sent += len(json.loads(camera.stdout.readline()))
            while figures["frames"] < sent:
                figures = json.loads(robot.stdout.readline())
            camera.stdin.close()
            camera.wait()
        assert (figures["frames"], figures["unreadable"]) == (sent, 0) == (30 * len(drives), 0)
        assert figures["imu"] > 6 * 30 * 2


@needs_ros
def test_a_live_survey_records_what_drivers_send(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(format_calibration(calibration()))
    (tmp_path / "sensors.toml").write_text(f'[source]\nkind = "ros2"\ncalibration = "{tmp_path}/rig.yaml"\n')
    drive = tmp_path / "drive.mcap"
    files = ("--store", tmp_path / "store", "--sensors", tmp_path / "sensors.toml", "--record", drive)
    with driver() as camera, ros_program("-m", "mapserver.cli", "live", "--site", "lab", *map(str, files)) as survey:
        begin(camera, frames=50, size_px=(320, 240), has_imu=True)
        sent_ns = json.loads(camera.stdout.readline())
        assert eventually(lambda: drive.stat().st_size > 30 * 2 * 320 * 240, 60.0)
        survey.send_signal(signal.SIGINT)  # of a standing robot no map is made
        survey.wait(60)
    with open_recording(drive) as recording:
        count = len(recording.frame_stamps_ns)
        assert recording.frame_stamps_ns.tolist() == sent_ns[:count] and count >= 30
        assert len(recording.imu.stamps_ns) > 6 * 30


def test_without_ros_the_robot_says_what_to_source(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(format_calibration(calibration()))
    with pytest.raises(UsageError, match=r"camchain"):
        open_source(SourceSection(kind="ros2"), Topics())
    for start in (
        lambda: open_source(SourceSection(kind="ros2", calibration=str(tmp_path / "rig.yaml")), Topics()),
        lambda: OUTPUT.open(OutputSection(format="ros2"), None, "hall", "r1", calibration(), None),
    ):
        with pytest.raises(UsageError, match=r"source /opt/ros"):
            start()
