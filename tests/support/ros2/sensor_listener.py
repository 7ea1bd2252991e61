"""A robot's side of its sensors: `python -m support.ros2.sensor_listener CALIBRATION [--publish]` reads topics as the daemon does, until
its standard input ends, and prints counts, CPU time and memory four times a second. CPU is that of ROS 2: of all threads but the one that
takes frames, and of publishing there."""

import json
import resource
import sys
import threading
import time
from pathlib import Path

import numpy as np

from fleetmap.recordings import Topics
from fleetmap.sensors.source_settings import SourceSection
from fleetmap.sources.intake import Intake
from locclient.outputs import OutputSection
from locclient.plugins.ros2_node import OUTPUT, open_topics
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.estimates import estimate


def main() -> None:
    source = open_topics(SourceSection(calibration=sys.argv[1]), Topics(), "map")
    intake = Intake(frames=5, imu_minus_cam_s=0.0, has_imu=source.calibration.imu is not None, imu_wait_s=0.05)
    ended = threading.Event()
    reading = threading.Thread(target=source.run, args=(intake, ended.wait))
    reading.start()
    publisher, odom = None, ContinuousOdom(np.eye(4))
    if "--publish" in sys.argv:
        publisher = OUTPUT.open(OutputSection(format="ros2"), None, "hall", "r1", source.calibration, intake)
    told_s, publishing_s, ticks = time.monotonic(), 0.0, 0
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    while not ended.is_set():
        frame = intake.take(0.2).frame
        if publisher is not None and frame is not None:
            told = estimate(frame.stamp_ns * 1e-9)
            published, begun_s = odom.handle(told), time.thread_time()
            publisher.publish(told, published, np.eye(4))
            publishing_s += time.thread_time() - begun_s
        if time.monotonic() - told_s < 0.25:
            continue
        told_s, ticks, begun_s = time.monotonic(), ticks + 1, time.thread_time()
        if publisher is not None and ticks % 4 == 0:
            publisher.alive(False)
            publishing_s += time.thread_time() - begun_s
        print(json.dumps(figures(intake, publishing_s)), flush=True)
    reading.join()
    if publisher is not None:
        publisher.close()
    source.close()


def figures(intake: Intake, publishing_s: float) -> dict[str, float]:
    counts, pages = intake.counts, int(Path("/proc/self/statm").read_text().split()[1])
    cpu_s, rss_mb = time.process_time() - time.thread_time() + publishing_s, pages * resource.getpagesize() / 1e6
    told = {"frames": counts.frames, "imu": counts.imu_samples, "unreadable": counts.unreadable}
    return told | {"cpu_s": cpu_s, "rss_mb": rss_mb}


if __name__ == "__main__":
    main()
