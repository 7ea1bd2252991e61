"""Recording of a robot that drives through a room with painted walls: images, depth, IMU, wheels and truth that agree.

Small, and made in seconds: it is there to be computed with, not to measure anything. The motion is known in closed form.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3, so3_exp, so3_log
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration
from fleetmap.sensors.samples import CameraFrame, Image, ImuSamples, SensorSet, Trajectory, WheelSample

WIDTH_PX, HEIGHT_PX, FOCAL_PX, BASELINE_M = 320, 240, 200.0, 0.2
FRAME_NS, IMU_NS = 50_000_000, 5_000_000
_START_NS = 1_000_000_000
_STAND_S = 1.0
_HALF_SIZE_M = np.array([4.0, 3.0, 1.5])
_TEXELS_PER_M, _TEXELS = 100, 800
_BODY_FROM_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.05, 0.0]))
_RIGHT = se3(np.eye(3), np.array([BASELINE_M, 0.0, 0.0]))
_GRAVITY_MPS2 = np.array([0.0, 0.0, 9.81])
_SIGMA_MPS, _SIGMA_RADPS = 0.05, 0.02  # of the wheels


@dataclass(frozen=True)
class Ride:
    """Stands for a second, then goes `reach_m` along the wall that it looks at, and back, swaying."""

    duration_s: float = 6.0
    reach_m: float = 3.6

    def map_from_body(self, time_s: float) -> Array:
        """Pose (4, 4) so many seconds after the start."""
        share = min(max((time_s - _STAND_S) / (self.duration_s - _STAND_S), 0.0), 1.0)
        phase = 2 * np.pi * share**3 * (10 - 15 * share + 6 * share**2)  # no jerk at either end
        place = [self.reach_m * (0.5 - np.cos(phase) / 2) - 2.0, 0.3 + 0.15 * np.sin(phase), 0.05 * np.sin(2 * phase)]
        turn = so3_exp(np.array([0.0, 0.0, np.pi / 3 + 0.5 * np.sin(phase)]))
        sway = so3_exp(np.array([0.06 * np.sin(2 * phase), 0.05 * np.sin(phase), 0.0]))
        return se3(turn @ sway, np.array(place))

    def motion(self, time_s: float, step_s: float = 1e-3) -> tuple[Array, Array, Array]:
        """Angular rate, velocity and specific force in body axes, by central differences."""
        before, now, after = (self.map_from_body(time_s + d) for d in (-step_s, 0.0, step_s))
        axes = now[:3, :3].T
        rate = so3_log(before[:3, :3].T @ after[:3, :3]) / (2 * step_s)
        velocity = (after[:3, 3] - before[:3, 3]) / (2 * step_s)
        acceleration = (before[:3, 3] - 2 * now[:3, 3] + after[:3, 3]) / step_s**2
        return rate, axes @ velocity, axes @ (acceleration + _GRAVITY_MPS2)


def rig(sensors: SensorSet) -> RigCalibration:
    """The calibration of a rig with these sensors; its lenses distort a little."""
    intrinsics = np.array([FOCAL_PX, FOCAL_PX, WIDTH_PX / 2 - 0.5, HEIGHT_PX / 2 - 0.5])
    lens = np.array([1e-9, 0.0, 0.0, 0.0])
    left = CameraCalibration("radial-tangential", WIDTH_PX, HEIGHT_PX, intrinsics, lens, _BODY_FROM_CAM)
    right = replace(left, body_from_cam=_BODY_FROM_CAM @ _RIGHT)
    has_right = sensors in (SensorSet.STEREO, SensorSet.STEREO_INERTIAL)
    imu = ImuNoise() if sensors in (SensorSet.STEREO_INERTIAL, SensorSet.MONO_INERTIAL) else None
    return RigCalibration((left, right) if has_right else (left,), imu)


def frame_at(ride: Ride, stamp_ns: int, sensors: SensorSet) -> CameraFrame:
    """Images of the rig at a time in nanoseconds after the start."""
    map_from_cam = ride.map_from_body(stamp_ns * 1e-9) @ _BODY_FROM_CAM
    left, depth_m = _view(map_from_cam)
    right = _view(map_from_cam @ _RIGHT)[0] if len(rig(sensors).cameras) > 1 else None
    return CameraFrame(_START_NS + stamp_ns, left, right, depth_m if sensors is SensorSet.RGBD else None)


def write_ride(path: Path, ride: Ride, sensors: SensorSet) -> None:
    """The ride as an MCAP file at `path`; RecordingError where it cannot be written."""
    calibration = rig(sensors)
    with McapRecordingWriter(path, calibration) as writer:
        for stamp_ns in range(0, int(ride.duration_s * 1e9), FRAME_NS):
            since_ns = np.arange(stamp_ns, stamp_ns + FRAME_NS, IMU_NS, dtype=np.int64)
            rates, velocities, forces = (
                np.array(v) for v in zip(*(ride.motion(s * 1e-9) for s in since_ns), strict=True)
            )
            stamps_ns = _START_NS + since_ns
            writer.write_frame(frame_at(ride, stamp_ns, sensors))
            if calibration.imu is not None:
                writer.write_imu(ImuSamples(stamps_ns, rates, forces))
            wheel = WheelSample(int(stamps_ns[0]), velocities[0], float(rates[0, 2]), _SIGMA_MPS, _SIGMA_RADPS)
            writer.write_wheel(wheel)
            truth = ride.map_from_body(stamp_ns * 1e-9)
            writer.write_ground_truth(Trajectory(stamps_ns[:1], truth[None]))


def _view(map_from_cam: Array) -> tuple[Image, NDArray[np.float32]]:
    """Grey image and depth of one camera: for each pixel the face of the room that its ray leaves by."""
    rays_cam = _rays_cam()
    rays, centre = rays_cam @ map_from_cam[:3, :3].T, map_from_cam[:3, 3]
    with np.errstate(divide="ignore"):
        reach = (np.sign(rays) * _HALF_SIZE_M - centre) / rays
    axis = np.argmin(reach, axis=-1)
    depth_m = np.take_along_axis(reach, axis[..., None], -1)
    hit = (centre + rays * depth_m + _HALF_SIZE_M) * _TEXELS_PER_M
    face = 2 * axis + (np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0)
    across = np.where(axis == 0, hit[..., 1], hit[..., 0])
    along = np.where(axis == 2, hit[..., 1], hit[..., 2]) + face * _TEXELS
    grey = cv2.remap(
        _paint(), *cv2.convertMaps(across.astype(np.float32), along.astype(np.float32), cv2.CV_16SC2), cv2.INTER_LINEAR
    )
    return np.asarray(grey, np.uint8), depth_m[..., 0].astype(np.float32)


@cache
def _rays_cam() -> Array:
    """(H, W, 3) rays of the pixels, one metre deep."""
    u, v = np.meshgrid(np.arange(WIDTH_PX), np.arange(HEIGHT_PX))
    flat = np.stack([u - (WIDTH_PX / 2 - 0.5), v - (HEIGHT_PX / 2 - 0.5)], -1) / FOCAL_PX
    return np.concatenate([flat, np.ones((HEIGHT_PX, WIDTH_PX, 1))], -1)


@cache
def _paint() -> Image:
    """Hard-edged patches on each face of the room, one face under another."""
    rng = np.random.default_rng(0)
    canvas = np.full((6 * _TEXELS, _TEXELS), 120.0, np.float32)
    for _ in range(3000):
        row, column = int(rng.integers(6 * _TEXELS)), int(rng.integers(_TEXELS))
        height, width = (int(v) for v in rng.integers(6, 45, 2))
        canvas[row : row + height, column : column + width] = rng.uniform(20, 235)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), 1.2), np.uint8)
