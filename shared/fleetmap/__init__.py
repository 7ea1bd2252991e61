"""Library of the map server and the robots: recordings, odometry, the map format, relocalization.

    from fleetmap import open_recording, write_tum

    with open_recording("survey.mcap") as recording:  # or a EuRoC, TUM-VI, KITTI or 7-Scenes folder
        print(recording.sensor_set, len(recording), "frames,", len(recording.imu), "IMU samples")
        left = recording.read_frame(0).left  # (H, W) uint8 grey
        write_tum("truth.tum", recording.ground_truth)

Names are imported when they are first used, so that `import fleetmap` stays light. Frames, units and pixels are those of
shared/README.md; every error is a `FleetmapError` whose message names the next step. examples/ holds whole programs.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fleetmap.errors import CalibrationError, FleetmapError, MapFormatError, RecordingError
    from fleetmap.odometry import OdometrySettings, make_odometry
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
_NAMES = {
    "errors": "CalibrationError FleetmapError MapFormatError RecordingError",
    "odometry": "OdometrySettings make_odometry",
    "recordings": "FrameSelection OpenOptions Recording RecordingFormat RECORDING_FORMATS Topics open_recording "
    "read_calibration",
    "recordings.tum": "read_tum write_tum",
    "sensors.samples": "Trajectory",
}
_MODULES = {name: f"fleetmap.{module}" for module, names in _NAMES.items() for name in names.split()}


def _version() -> str:
    from importlib import metadata  # takes a tenth of a second

    try:
        return metadata.version("fleetmap")
    except metadata.PackageNotFoundError:
        return "0+source"  # a source tree that is not installed


def __getattr__(name: str) -> object:
    """Import a public name at its first use (PEP 562)."""
    if name == "__version__":
        return _version()
    if name not in _MODULES:
        raise AttributeError(f"module 'fleetmap' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
