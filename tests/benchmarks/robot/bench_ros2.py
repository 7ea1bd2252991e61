"""What ROS 2 costs a robot: a stereo driver of rclpy at 30 Hz and 752x480 sends to the robot's side, raw for long, then compressed, then
with an IMU of 210 Hz while the robot publishes its estimates. CPU per frame is that of ROS 2 in the robot's process.

Needs `make ros2-env`.
"""

import json
import select
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.common.recorded_runs import Options, Results, benchmark
from benchmarks.common.yardstick import at_reference, slowness
from fleetmap.recordings.calibration_files import format_calibration
from support.recordings.recording_samples import calibration
from support.ros2.environment import ros_program

_RATE_HZ = 30
_SETTLED_S = 10  # after which memory must not grow
_SHORT_S = 60
_LATE_LINES = 8  # of the listener, two seconds, in which it takes what waits


def measured(rig: Path, driver: dict[str, Any], robot: list[str]) -> dict[str, float | None]:
    """Figures of a drive."""
    before, lines = slowness(), list[dict[str, float]]()
    with ros_program("-m", "support.ros2.sensor_listener", str(rig), *robot) as process:
        with ros_program("-m", "support.ros2.camera_driver") as camera:
            camera.stdin.write(json.dumps(driver) + "\n")
            camera.stdin.close()
            camera.stdout.readline()
            while not select.select([camera.stdout], [], [], 0)[0]:
                lines.append(json.loads(process.stdout.readline()))
            sent = len(json.loads(camera.stdout.readline()))
        last = [json.loads(process.stdout.readline()) for _ in range(_LATE_LINES)][-1]
        process.communicate()
    running = [line for line in lines if line["frames"] > _SETTLED_S * _RATE_HZ]
    first, final = running[0], running[-1]
    cpu_ms = 1e3 * (final["cpu_s"] - first["cpu_s"]) / (final["frames"] - first["frames"])
    return {
        "sent": sent,
        "lost_share": 1 - last["frames"] / sent,
        "cpu_ms": cpu_ms,
        "cpu_ms_at_reference": at_reference(cpu_ms, [before, slowness()]),
        "rss_growth_mb": final["rss_mb"] - first["rss_mb"],
    }


@benchmark(seconds=1200)
def main(options: Options) -> Results:
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder) / "rig.yaml"
        rig.write_text(format_calibration(replace(calibration(), imu=None)))
        with_imu = Path(folder) / "inertial.yaml"
        with_imu.write_text(format_calibration(calibration()))
        frames, short = options.seconds * _RATE_HZ, min(options.seconds, _SHORT_S) * _RATE_HZ
        return {
            "raw": measured(rig, {"frames": frames}, []),
            "compressed": measured(rig, {"frames": short, "is_compressed": True}, []),
            "raw, IMU, estimates": measured(with_imu, {"frames": short, "has_imu": True}, ["--publish"]),
        }
