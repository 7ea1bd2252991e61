"""Sensors of ROS itself: drivers of rclpy in other processes, which send to those whom the graph shows as subscribers."""

import json
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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


def driver(*options: object) -> Iterator[int]:
    return ros_program("-m", "support.ros2.camera_driver", *map(str, options))


@contextmanager
def listener(folder: Path, told: list[dict[str, float]]) -> Iterator[None]:
    """The robot's side; its last figures are appended at its end."""
    (folder / "rig.yaml").write_text(format_calibration(calibration()))
    with ros_program("-m", "support.ros2.sensor_listener", str(folder / "rig.yaml")) as process:
        assert process.stdout.readline(), "it runs"
        yield
        process.stdin.close()
        told.append(json.loads(process.stdout.read().splitlines()[-1]))


@needs_ros
@pytest.mark.parametrize("options", [(), ("--compressed", "--imu"), ("--best-effort",)])
def test_all_frames_of_a_driver_arrive(
    tmp_path: Path, options: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Started before the robot and after it, and started again in another quality."""
    if "--best-effort" in options:
        monkeypatch.setenv(
            "FASTDDS_DEFAULT_PROFILES_FILE", str(REPOSITORY / "deploy/ros2/fleetmap_ros/config/fastdds.xml")
        )
    told: list[dict[str, float]] = []
    with driver(90, *options) as early:
        time.sleep(2.0)
        with listener(tmp_path, told):
            assert early.wait(60) == 0
            sent = int(early.stdout.read())
            for more in (options, ()):
                with driver(60, *more) as late:
                    assert late.wait(60) == 0
                    sent += int(late.stdout.read())
    (figures,) = told
    assert (figures["frames"], figures["unreadable"]) == (sent, 0) == (210, 0)
    assert figures["imu"] > 6 * 90 or "--imu" not in options


@needs_ros
def test_a_live_survey_records_what_drivers_send(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(format_calibration(calibration()))
    (tmp_path / "sensors.toml").write_text(f'[source]\nkind = "ros2"\ncalibration = "{tmp_path}/rig.yaml"\n')
    files = ("--store", tmp_path / "store", "--sensors", tmp_path / "sensors.toml", "--record", tmp_path / "drive.mcap")
    with ros_program("-m", "mapserver.cli", "live", "--site", "lab", *map(str, files)) as survey:
        with driver(60, "--imu", "--size", "320x240") as camera:
            assert camera.wait(60) == 0
            sent = int(camera.stdout.read())
        survey.send_signal(signal.SIGINT)  # of a standing robot no map is made
        survey.wait(60)
    with open_recording(tmp_path / "drive.mcap") as recording:
        assert len(recording.frame_stamps_ns) == sent == 60
        assert len(recording.imu.stamps_ns) > 6 * 60


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
