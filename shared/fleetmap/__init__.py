"""Library of the map server and the robots: recordings, odometry, the map format, relocalization.

    from fleetmap import open_recording, write_tum

    with open_recording("survey.mcap") as recording:  # or a EuRoC, TUM-VI, KITTI or 7-Scenes folder
        print(recording.sensor_set, len(recording), "frames,", len(recording.imu), "IMU samples")
        left = recording.read_frame(0).left  # (H, W) uint8 grey
        write_tum("truth.tum", recording.ground_truth)

Names are imported when they are first used, so that `import fleetmap` stays light. Frames, units and pixels are those of
shared/README.md; every error is a `FleetmapError` whose message names the next step. examples/ holds whole programs.
"""

from typing import TYPE_CHECKING

from fleetmap.lazy_names import lazy_names

if TYPE_CHECKING:
    from fleetmap.errors import CalibrationError, FleetmapError, MapFormatError, RecordingError
    from fleetmap.odometry.mono.mono_modes import make_odometry
    from fleetmap.odometry.settings import OdometrySettings
    from fleetmap.recordings import (
        RECORDING_FORMATS,
        FrameSelection,
        OpenOptions,
        Recording,
        RecordingFormat,
        Topics,
        open_recording,
        read_calibration,
    )
    from fleetmap.recordings.tum import read_tum, write_tum
    from fleetmap.sensors.samples import Trajectory
    from fleetmap.version import __version__

__all__ = [
    "RECORDING_FORMATS",
    "CalibrationError",
    "FleetmapError",
    "FrameSelection",
    "MapFormatError",
    "OdometrySettings",
    "OpenOptions",
    "Recording",
    "RecordingError",
    "RecordingFormat",
    "Topics",
    "Trajectory",
    "__version__",
    "make_odometry",
    "open_recording",
    "read_calibration",
    "read_tum",
    "write_tum",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "fleetmap.errors": "CalibrationError FleetmapError MapFormatError RecordingError",
        "fleetmap.odometry.mono.mono_modes": "make_odometry",
        "fleetmap.odometry.settings": "OdometrySettings",
        "fleetmap.recordings": "FrameSelection OpenOptions Recording RecordingFormat RECORDING_FORMATS Topics open_recording "
        "read_calibration",
        "fleetmap.recordings.tum": "read_tum write_tum",
        "fleetmap.sensors.samples": "Trajectory",
        "fleetmap.version": "__version__",
    },
)
