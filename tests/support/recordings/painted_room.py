"""Recording of a robot that drives through the box room: images, depth, IMU, wheels and truth that agree, without noise."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, Image, ImuSamples, SensorSet, Trajectory, WheelSample
from support.recordings.recording_samples import FRAME_NS, IMU_NS, calibration
from support.worlds.box_room import RAYS, ROOM_M, TEXEL_M, TEXELS, Ride, depth_of, motion
from support.worlds.painted_walls import view

START_NS = 1_000_000_000
REAR = se3(so3_exp(np.array([0.0, 0.0, np.pi])), np.array([-0.1, 0.0, 0.0]))  # body_from_turned
_STAND_S = 1.0
_MOVED = se3(np.eye(3), np.array([0.0, -0.01, 0.02]))
_SIGMA_MPS, _SIGMA_RADPS = 0.05, 0.02  # of the wheels


def standing_first(duration_s: float = 6.0, reach_m: float = 3.6) -> Ride:
    """Stands for a second, then goes `reach_m` along the wall that it looks at, and back, swaying."""

    def map_from_body(time_s: float) -> Array:
        share = min(max((time_s - _STAND_S) / (duration_s - _STAND_S), 0.0), 1.0)
        phase = 2 * np.pi * share**3 * (10 - 15 * share + 6 * share**2)  # no jerk at either end
        place = [reach_m * (0.5 - np.cos(phase) / 2) - 2.0, 0.3 + 0.15 * np.sin(phase), 0.05 * np.sin(2 * phase)]
        turn = so3_exp(np.array([0.0, 0.0, np.pi / 3 + 0.5 * np.sin(phase)]))
        return se3(turn @ so3_exp(np.array([0.06 * np.sin(2 * phase), 0.05 * np.sin(phase), 0.0])), np.array(place))

    return map_from_body


def rig(sensors: SensorSet, *, has_rear: bool = False) -> RigCalibration:
    """The calibration of a rig with these sensors; has_rear: and with the same cameras looking backwards."""
    whole = calibration(has_imu=sensors in (SensorSet.STEREO_INERTIAL, SensorSet.MONO_INERTIAL))
    cameras = whole.cameras[: 2 if sensors in (SensorSet.STEREO, SensorSet.STEREO_INERTIAL) else 1]
    cameras = tuple(replace(c, body_from_cam=_MOVED @ c.body_from_cam) for c in cameras)
    rear = tuple(replace(c, body_from_cam=REAR @ c.body_from_cam) for c in cameras) if has_rear else ()
    return replace(whole, cameras=(*cameras, *rear))


def frame_at(ride: Ride, stamp_ns: int, sensors: SensorSet) -> CameraFrame:
    """Images of the rig at a time in nanoseconds after the start."""
    cameras = [ride(stamp_ns * 1e-9) @ camera.body_from_cam for camera in rig(sensors).cameras]
    left, right = (view(at, RAYS, ROOM_M, _paint(), ROOM_M[0], TEXEL_M) for at in (cameras[0], cameras[-1]))
    depth_m = depth_of(cameras[0]) if sensors is SensorSet.RGBD else None
    return CameraFrame(START_NS + stamp_ns, left, right if len(cameras) > 1 else None, depth_m)


def frame_of_both(ride: Ride, stamp_ns: int) -> CameraFrame:
    """Images of a pair in front and one behind."""
    front, rear = (frame_at(each, stamp_ns, SensorSet.STEREO) for each in (ride, from_behind(ride)))
    return replace(front, others=(rear,))


def from_behind(ride: Ride) -> Ride:
    """The ride as the rear pair sees it."""
    return lambda time_s: ride(time_s) @ REAR


def measured(ride: Ride, begin_ns: int, end_ns: int) -> tuple[ImuSamples, WheelSample]:
    """What the IMU measures between two times after the start, and the wheels at the first."""
    since_ns = np.arange(begin_ns, end_ns, IMU_NS, dtype=np.int64)
    rates, velocities, forces = (np.array(v) for v in zip(*(motion(ride, s * 1e-9) for s in since_ns), strict=True))
    stamps_ns = START_NS + since_ns
    wheel = WheelSample(int(stamps_ns[0]), velocities[0], float(rates[0, 2]), _SIGMA_MPS, _SIGMA_RADPS)
    return ImuSamples(stamps_ns, rates, forces), wheel


def write_ride(path: Path, ride: Ride, duration_s: float, sensors: SensorSet) -> None:
    """So many seconds of the ride as an MCAP file at `path`; RecordingError where it cannot be written."""
    calibration = rig(sensors)
    with McapRecordingWriter(path, calibration) as writer:
        for stamp_ns in range(0, int(duration_s * 1e9), FRAME_NS):
            imu, wheel = measured(ride, stamp_ns, stamp_ns + FRAME_NS)
            writer.write_frame(frame_at(ride, stamp_ns, sensors))
            if calibration.imu is not None:
                writer.write_imu(imu)
            writer.write_wheel([wheel])
            writer.write_ground_truth(Trajectory(imu.stamps_ns[:1], ride(stamp_ns * 1e-9)[None]))


@cache
def _paint() -> Image:
    """Hard-edged patches on each face of the room, one face under another."""
    rng = np.random.default_rng(0)
    canvas = np.full((6 * TEXELS, TEXELS), 120.0, np.float32)
    for _ in range(3000):
        row, column = int(rng.integers(6 * TEXELS)), int(rng.integers(TEXELS))
        height, width = (int(v) for v in rng.integers(6, 45, 2))
        canvas[row : row + height, column : column + width] = rng.uniform(20, 235)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), 1.2), np.uint8)
