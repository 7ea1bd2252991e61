"""How slow this machine is just now, beside the one whose milliseconds the limits are.

Limits in milliseconds of CPU were set on a machine that takes 1.0 ms for two remaps of a 752x480 pair, 5.7 ms to find its corners and
4.0 ms for 400 ORB features. The same work is timed here, with the same pictures, before and after what is measured; a shared machine
is two or three times slower from one hour to the next. It is timed in a process of its own: in one that replayed before, the allocator
keeps its pages, and the same work takes two thirds of that.
"""

import os
import subprocess
import sys
import time

import cv2
import numpy as np

from fleetmap.recordings import open_recording
from support.recordings.realdata import DATA

REFERENCE_MS = 1.0 + 5.7 + 4.0
_RECORDING, _FRAME, _REPEATS = "euroc_mh01_start", 50, 15


def slowness() -> float | None:
    """Times the reference's CPU time, by the median of some repeats; None where the pictures are not there."""
    if not (DATA / _RECORDING).is_dir():
        return None
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return float(subprocess.check_output([sys.executable, "-m", "benchmarks.common.yardstick"], env=paths))


def _slowness() -> float:
    cv2.setNumThreads(1)
    with open_recording(DATA / _RECORDING) as recording:
        frame = recording.read_frame(_FRAME)
    left, right = frame.left, frame.right
    height, width = left.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    maps = cv2.convertMaps(x + 0.3 * np.sin(y / 50), y, cv2.CV_16SC2)
    orb = cv2.ORB.create(400)

    def work() -> None:
        cv2.remap(left, *maps, cv2.INTER_LINEAR)
        cv2.remap(right, *maps, cv2.INTER_LINEAR)
        cv2.goodFeaturesToTrack(left, 150, 0.01, 20)
        orb.detectAndCompute(left, None)

    work()
    taken = []
    for _ in range(_REPEATS):
        begun_s = time.process_time()
        work()
        taken.append(1e3 * (time.process_time() - begun_s))
    return float(np.median(taken)) / REFERENCE_MS


def mean_of(seen: list[float | None]) -> float | None:
    """Of several looks, None where there was none."""
    known = [value for value in seen if value is not None]
    return float(np.mean(known)) if known else None


def at_reference(taken: float | None, seen: list[float | None]) -> float | None:
    """CPU time, in any unit, that the reference would take; None where either is unknown."""
    slow = mean_of(seen)
    return None if taken is None or slow is None else taken / slow


if __name__ == "__main__":
    print(_slowness())
