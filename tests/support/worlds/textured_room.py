"""Stereo pictures of a room with painted walls, seen along the analytic motion. Small on purpose."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration
from fleetmap.sensors.rectification import MountedCamera, MountedRig, RectifiedFrame, StereoCamera
from support.worlds import painted_walls
from support.worlds.inertial_motion import analytic_motion

CAMERA = StereoCamera(190.0, 160.0, 100.0, 0.12, 320, 200)
BODY_FROM_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.05, 0.03, 0.02]))
_RAYS = painted_walls.pixel_rays(CAMERA.width_px, CAMERA.height_px, CAMERA.focal_px, CAMERA.cx_px, CAMERA.cy_px)
_ROOM_M = np.array([[-4.5, -4.0, -2.0], [4.5, 4.0, 2.0]])
_SIDE, _TEXEL_M = 720, 1 / 70
_BEGIN_M = np.full(3, -_SIDE / 2 * _TEXEL_M)


def rig(imu: ImuNoise | None) -> RigCalibration:
    """The calibration that belongs to the pictures."""
    intrinsics = np.array([CAMERA.focal_px, CAMERA.focal_px, CAMERA.cx_px, CAMERA.cy_px])
    left = CameraCalibration(
        "radial-tangential", CAMERA.width_px, CAMERA.height_px, intrinsics, np.zeros(4), BODY_FROM_CAM
    )
    beside = BODY_FROM_CAM @ se3(np.eye(3), np.array([CAMERA.baseline_m, 0, 0]))
    right = CameraCalibration("radial-tangential", CAMERA.width_px, CAMERA.height_px, intrinsics, np.zeros(4), beside)
    return RigCalibration((left, right), imu)


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


@lru_cache(maxsize=400)
def stereo_frame(stamp_ns: int, seed: int = 1) -> RectifiedFrame:
    """The pair at one moment of the analytic motion."""
    map_from_cam = analytic_motion(stamp_ns * 1e-9).map_from_body @ BODY_FROM_CAM
    map_from_right = map_from_cam @ se3(np.eye(3), np.array([CAMERA.baseline_m, 0, 0]))
    return RectifiedFrame(stamp_ns, view(map_from_cam, seed), view(map_from_right, seed), None)


def black_frame(stamp_ns: int) -> RectifiedFrame:
    """Nothing to see."""
    nothing = np.zeros((CAMERA.height_px, CAMERA.width_px), np.uint8)
    return RectifiedFrame(stamp_ns, nothing, nothing.copy(), None)
