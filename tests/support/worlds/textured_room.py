"""Stereo pictures of a room with painted walls, seen along the analytic motion. Small on purpose."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration
from fleetmap.sensors.rectification import MountedCamera, MountedRig, RectifiedFrame, StereoCamera
from support.worlds.inertial_motion import analytic_motion

CAMERA = StereoCamera(190.0, 160.0, 100.0, 0.12, 320, 200)
BODY_FROM_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.05, 0.03, 0.02]))
HALF_SIZE_M = np.array([4.5, 4.0, 2.0])
_PIXELS_PER_M = 70.0
_SIDE = 720


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
    u, v = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    rays_cam = np.stack(
        [(u - CAMERA.cx_px) / CAMERA.focal_px, (v - CAMERA.cy_px) / CAMERA.focal_px, np.ones(u.shape)], -1
    )
    rays_map, centre = rays_cam @ map_from_cam[:3, :3].T, map_from_cam[:3, 3]
    with np.errstate(divide="ignore"):
        reach = (np.sign(rays_map) * HALF_SIZE_M - centre) / rays_map
    axis = np.argmin(reach, axis=-1)
    hit = centre + rays_map * np.take_along_axis(reach, axis[..., None], -1)
    first = np.where(axis == 0, hit[..., 1], hit[..., 0])
    second = np.where(axis == 2, hit[..., 1], hit[..., 2])
    positive = np.take_along_axis(rays_map, axis[..., None], -1)[..., 0] > 0
    wall = 2 * axis + positive
    x = (first * _PIXELS_PER_M + _SIDE / 2).astype(np.float32)
    y = (second * _PIXELS_PER_M + _SIDE / 2 + wall * _SIDE).astype(np.float32)
    return np.asarray(cv2.remap(_walls(seed), *cv2.convertMaps(x, y, cv2.CV_16SC2), cv2.INTER_LINEAR), np.uint8)


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
