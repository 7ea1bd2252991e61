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
    from fleetmap.errors import CalibrationError as CalibrationError
    from fleetmap.errors import FleetmapError as FleetmapError
    from fleetmap.errors import MapFormatError as MapFormatError
    from fleetmap.errors import RecordingError as RecordingError
    from fleetmap.odometry.mono.mono_modes import make_odometry as make_odometry
    from fleetmap.odometry.settings import OdometrySettings as OdometrySettings
    from fleetmap.recordings import RECORDING_FORMATS as RECORDING_FORMATS
    from fleetmap.recordings import FrameSelection as FrameSelection
    from fleetmap.recordings import OpenOptions as OpenOptions
    from fleetmap.recordings import Recording as Recording
    from fleetmap.recordings import RecordingFormat as RecordingFormat
    from fleetmap.recordings import Topics as Topics
    from fleetmap.recordings import open_recording as open_recording
    from fleetmap.recordings import read_calibration as read_calibration
    from fleetmap.recordings.tum import read_tum as read_tum
    from fleetmap.recordings.tum import write_tum as write_tum
    from fleetmap.sensors.samples import Trajectory as Trajectory
    from fleetmap.version import __version__ as __version__

_NAMES = {
    "fleetmap.errors": "CalibrationError FleetmapError MapFormatError RecordingError",
    "fleetmap.odometry.mono.mono_modes": "make_odometry",
    "fleetmap.odometry.settings": "OdometrySettings",
    "fleetmap.recordings": "FrameSelection OpenOptions Recording RecordingFormat RECORDING_FORMATS Topics open_recording "
    "read_calibration",
    "fleetmap.recordings.tum": "read_tum write_tum",
    "fleetmap.sensors.samples": "Trajectory",
    "fleetmap.version": "__version__",
}
__all__, __getattr__, __dir__ = lazy_names(__name__, _NAMES)
