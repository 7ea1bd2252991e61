"""Sources of a survey's initial trajectory: our own odometry, or the poses of another SLAM system."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fleetmap.errors import UsageError
from fleetmap.recordings import Recording
from fleetmap.recordings.tum import format_stamp, read_tum
from fleetmap.sensors.samples import SensorSet, Stamps, Trajectory

TrajectorySource = Callable[[Recording, Stamps, Path | None], Trajectory | None]
"""Of a recording, the stamps (F,) of its selected frames and a file: frame_from_body at those stamps, None for own odometry."""


def own_odometry(recording: Recording, stamps_ns: Stamps, file: Path | None) -> None:
    """No poses: the survey runs the odometry. UsageError where a file is named, which nobody would read."""
    if file is not None:
        raise UsageError(f"--initial-trajectory {file} is not read by --trajectory-source odometry; name its format")


def tum_poses(recording: Recording, stamps_ns: Stamps, file: Path | None) -> Trajectory:
    """Poses of a TUM file, in metres and of the recording's body, interpolated at the stamps.

    UsageError without a file, for a single camera, and where a frame has no poses on both sides within 0.2 s.
    """
    if file is None:
        raise UsageError("--trajectory-source tum needs --initial-trajectory FILE.tum")
    if recording.sensor_set in (SensorSet.MONO, SensorSet.MONO_INERTIAL):
        raise UsageError(f"{recording.path} is {recording.sensor_set}; --trajectory-source tum needs stereo or depth")
    trajectory = read_tum(file)
    found = [trajectory.at(int(stamp)) for stamp in stamps_ns]
    missing = [format_stamp(int(stamp)) for stamp, there in zip(stamps_ns, found, strict=True) if there is None]
    if missing:
        raise UsageError(
            f"{file} has no pose for {len(missing)} of {len(stamps_ns)} frames of {recording.name}: {', '.join(missing[:5])}"
            f"{', ...' if len(missing) > 5 else ''}; select frames that it covers with --frames"
        )
    return Trajectory(stamps_ns, np.array(found).reshape(-1, 4, 4))


TRAJECTORY_SOURCES: dict[str, TrajectorySource] = {"odometry": own_odometry, "tum": tum_poses}


def trajectory_source(name: str) -> TrajectorySource:
    """The source of that name; UsageError for any other."""
    if name not in TRAJECTORY_SOURCES:
        raise UsageError(f"--trajectory-source {name}: the sources are {', '.join(TRAJECTORY_SOURCES)}")
    return TRAJECTORY_SOURCES[name]
