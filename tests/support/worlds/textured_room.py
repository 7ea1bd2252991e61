"""Stereo pictures of a room with painted walls, seen along the analytic motion. Small on purpose."""

from collections.abc import Callable, Iterable
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.odometry.odometry import Odometry
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration
from fleetmap.sensors.rectification import MountedCamera, MountedRig, RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import ImuSamples
from support.worlds import painted_walls
from support.worlds.inertial_motion import analytic_motion

CAMERA = StereoCamera(190.0, 160.0, 100.0, 0.12, 320, 200)
BODY_FROM_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.05, 0.03, 0.02]))
_LEFT_FROM_RIGHT = se3(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0]))
FRAME_NS, IMU = 50_000_000, ImuNoise(2e-4, 1e-5, 2e-3, 1e-4)  # of a robot
_RAYS = painted_walls.pixel_rays(CAMERA.width_px, CAMERA.height_px, CAMERA.focal_px, CAMERA.cx_px, CAMERA.cy_px)
_ROOM_M = np.array([[-4.5, -4.0, -2.0], [4.5, 4.0, 2.0]])
_SIDE, _TEXEL_M = 720, 1 / 70
_BEGIN_M = np.full(3, -_SIDE / 2 * _TEXEL_M)


def rig(imu: ImuNoise | None) -> RigCalibration:
    """The calibration that belongs to the pictures."""
    intrinsics = np.array([CAMERA.focal_px, CAMERA.focal_px, CAMERA.cx_px, CAMERA.cy_px])
    lens = "radial-tangential", CAMERA.width_px, CAMERA.height_px, intrinsics, np.zeros(4)
    places = BODY_FROM_CAM, BODY_FROM_CAM @ _LEFT_FROM_RIGHT
    return RigCalibration(tuple(CameraCalibration(*lens, body_from_cam) for body_from_cam in places), imu)


def mounted(imu: ImuNoise | None) -> MountedRig:
    """The same, rectified."""
    return MountedRig(rig(imu), (MountedCamera(CAMERA, BODY_FROM_CAM),))


@lru_cache(maxsize=2)
def _walls(seed: int) -> NDArray[np.uint8]:
    """(6 * side, side): one noise picture under another, for the walls -x +x -y +y -z +z."""
    rng = np.random.default_rng(seed)
    fine = cv2.GaussianBlur(rng.normal(size=(6 * _SIDE, _SIDE)), (0, 0), 2.5)
    coarse = cv2.GaussianBlur(rng.normal(size=(6 * _SIDE, _SIDE)), (0, 0), 12.0)
    grey = 128 + 35 * fine / fine.std() + 25 * coarse / coarse.std()
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def view(map_from_cam: Array, seed: int = 1) -> NDArray[np.uint8]:
    """Image of the room by one camera inside."""
    return painted_walls.view(map_from_cam, _RAYS, _ROOM_M, _walls(seed), _BEGIN_M, _TEXEL_M)


def pair(stamp_ns: int, map_from_body: Array, seed: int = 1) -> RectifiedFrame:
    """What a body there sees."""
    left = map_from_body @ BODY_FROM_CAM
    return RectifiedFrame(stamp_ns, view(left, seed), view(left @ _LEFT_FROM_RIGHT, seed), None)


@lru_cache(maxsize=400)
def stereo_frame(stamp_ns: int, seed: int = 1) -> RectifiedFrame:
    """The pair at one moment of the analytic motion."""
    return pair(stamp_ns, analytic_motion(stamp_ns * 1e-9).map_from_body, seed)


def driven(
    odometry: Odometry, frames: Iterable[RectifiedFrame], samples: ImuSamples,
    before: Callable[[Odometry, RectifiedFrame], object] = lambda *_: None,
) -> list[OdometryEstimate]:  # fmt: skip
    """Estimates of these frames, each after the samples since the one before. before: something done before each."""
    estimates, fed_ns = [], int(samples.stamps_ns[0])
    for frame in frames:
        odometry.handle_imu(samples.between(fed_ns, frame.stamp_ns + 1))
        fed_ns = frame.stamp_ns + 1
        before(odometry, frame)
        estimates.append(odometry.handle_stereo(frame))
    return estimates


def black_frame(stamp_ns: int) -> RectifiedFrame:
    """Nothing to see."""
    nothing = np.zeros((CAMERA.height_px, CAMERA.width_px), np.uint8)
    return RectifiedFrame(stamp_ns, nothing, nothing.copy(), None)
