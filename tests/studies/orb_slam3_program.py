"""ORB-SLAM3 by its wheel, over what studies/orb_slam3.py writes: a program of an environment of its own, which imports nothing of ours.

    python orb_slam3_program.py FOLDER

The folder holds settings.yaml, vocabulary.txt, stamps.txt (seconds) and the images as files, left and right. Pairs are given at the
recording's rate, as the examples of its authors do. Into the folder go poses.tum, world_from_left, and begun.txt: the CPU seconds
until the first pair.
"""

import sys
import time
from pathlib import Path

import cv2
import pyorbslam3


def main(folder: Path) -> None:
    """Tracks all pairs and writes the poses."""
    files = [sorted((folder / side).iterdir()) for side in ("left", "right")]
    stamps_s = [float(line) for line in (folder / "stamps.txt").read_text().split()]
    system = pyorbslam3.Slam(folder / "vocabulary.txt", folder / "settings.yaml", pyorbslam3.Sensor.STEREO)
    (folder / "begun.txt").write_text(str(time.process_time()))
    begun_s = time.monotonic()
    for stamp_s, *pair in zip(stamps_s, *files, strict=True):
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in pair]
        time.sleep(max(0.0, begun_s + stamp_s - time.monotonic()))
        system.track_stereo(*images, stamp_s)
    system.shutdown()
    system.save_trajectory_tum(str(folder / "poses.tum"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
