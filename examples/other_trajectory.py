"""A map from a planar robot's poses: python examples/other_trajectory.py RECORDING POSES.csv STORE SITE

`mapserver build --trajectory` reads the files of many SLAM systems. This adds one of one's own: lines `seconds,x,y,yaw` of a robot that
knows three degrees of freedom. Whose poses they are, which way the transform goes, their unit and their scale are found out by comparing
with the recording; the survey then adjusts them together with the landmarks.
"""

import sys
from pathlib import Path

import numpy as np

from mapserver import BuildOptions, build_map
from mapserver.build.trajectory import TRAJECTORY_FORMATS, OtherTrajectory, PoseRows
from mapserver.build.trajectory.formats import billionths


def planar_rows(path: Path) -> PoseRows:
    """The poses in a file of `seconds,x,y,yaw`; ValueError for anything else."""
    fields = [line.split(",") for line in path.read_text("utf-8").splitlines()]
    x, y, yaw = np.array([[float(value) for value in row[1:4]] for row in fields]).T
    zero = np.zeros(len(fields))
    xyzw = np.column_stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)])
    return PoseRows([billionths(row[0]) for row in fields], np.column_stack([x, y, zero]), xyzw)


TRAJECTORY_FORMATS["planar"] = planar_rows


def main(recording: str, file: str, store: str, site: str) -> None:
    """Builds a draft from the poses and says what came of it."""
    options = BuildOptions(trajectory=OtherTrajectory(Path(file), "planar"))
    draft = build_map([recording], store, site, options)
    print(draft.sentence)


if __name__ == "__main__":
    main(*sys.argv[1:])
