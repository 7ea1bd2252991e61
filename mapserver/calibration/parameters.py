"""Parameters of a rig's calibration that a recording can show, and the corrected rig.

All are corrections to the calibration that a recording came with: zero where that is right. Axes of the pair are the rectified ones of
that calibration: x along the baseline, y down, z ahead.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.rectification import Rectifier


class CalibrationParameter(StrEnum):
    """Estimated parameters. Shares are true / given - 1."""

    BASELINE = "baseline"
    FOCAL = "focal length"
    FOCAL_RATIO = "focal ratio"
    PRINCIPAL_X = "principal point x"
    PRINCIPAL_Y = "principal point y"
    PAIR_PITCH = "pair pitch"
    PAIR_YAW = "pair yaw"
    PAIR_ROLL = "pair roll"
    BASELINE_Y = "baseline direction y"
    BASELINE_Z = "baseline direction z"
    CAMERA_IMU_X = "camera to IMU x"
    CAMERA_IMU_Y = "camera to IMU y"
    CAMERA_IMU_Z = "camera to IMU z"
    CAMERA_POSITION_X = "camera position x"
    CAMERA_POSITION_Y = "camera position y"
    CAMERA_POSITION_Z = "camera position z"
    TIME_OFFSET = "time offset"
    WHEEL_SCALE = "wheel scale"
    GYRO_NOISE = "gyro noise"
    ACCEL_NOISE = "accelerometer noise"


P = CalibrationParameter
# The noise scales are not columns of the adjustment: they follow from its residuals.
COLUMNS: tuple[CalibrationParameter, ...] = tuple(p for p in P if p not in (P.GYRO_NOISE, P.ACCEL_NOISE))
# Errors of the lens model are estimated but not reported: distortion of both lenses, the right one's difference and principal point.
# Their sigma is the residual error of a board calibration, 0.3 px at the corner of a wide image, so other parameters do not absorb them.
# Tangential terms resemble a shift of the principal point: with a wide prior they would absorb errors of the images.
DISTORTION = 4
LENS_SIGMAS = np.array([1e-3, 1e-3, 5e-5, 5e-5] * 2 + [1e-3] * 2)
UNKNOWNS = len(COLUMNS) + len(LENS_SIGMAS)
INDEX: dict[CalibrationParameter, int] = {p: n for n, p in enumerate(COLUMNS)}


@dataclass(frozen=True, slots=True)
class ParameterRange:
    """Unit; sigma of the error of a careless calibration; sigma above which an estimate is useless.

    A limit is the error that displaces a point at 3 m by about 1 cm, or the image by half a pixel.
    """

    unit: str
    prior_sigma: float
    useful_sigma: float


# By unit: factor to the displayed unit, and number of digits
SHOWN = {
    "": (100.0, "%", 2),
    "rad": (float(np.degrees(1.0)), "degrees", 3),
    "s": (1e3, "ms", 1),
    "m": (1e3, "mm", 0),
    "px": (1.0, "px", 2),
}
RANGES: dict[CalibrationParameter, ParameterRange] = {
    P.BASELINE: ParameterRange("", 0.3, 0.01),
    P.FOCAL: ParameterRange("", 0.3, 0.005),
    P.FOCAL_RATIO: ParameterRange("", 0.05, 0.002),
    P.PRINCIPAL_X: ParameterRange("px", 40.0, 2.0),
    P.PRINCIPAL_Y: ParameterRange("px", 40.0, 2.0),
    P.PAIR_PITCH: ParameterRange("rad", 0.03, 5e-4),
    P.PAIR_YAW: ParameterRange("rad", 0.03, 5e-4),
    P.PAIR_ROLL: ParameterRange("rad", 0.03, 1e-3),
    P.BASELINE_Y: ParameterRange("rad", 0.02, 5e-3),
    P.BASELINE_Z: ParameterRange("rad", 0.02, 5e-3),
    P.CAMERA_IMU_X: ParameterRange("rad", 0.1, 3e-3),
    P.CAMERA_IMU_Y: ParameterRange("rad", 0.1, 3e-3),
    P.CAMERA_IMU_Z: ParameterRange("rad", 0.1, 3e-3),
    P.CAMERA_POSITION_X: ParameterRange("m", 0.03, 0.01),
    P.CAMERA_POSITION_Y: ParameterRange("m", 0.03, 0.01),
    P.CAMERA_POSITION_Z: ParameterRange("m", 0.03, 0.01),
    P.TIME_OFFSET: ParameterRange("s", 0.05, 2e-3),
    # Tyres wear and deform under load: half a per cent is the accuracy of a robot's odometry without calibration
    P.WHEEL_SCALE: ParameterRange("", 0.005, 0.005),
    P.GYRO_NOISE: ParameterRange("", 10.0, 0.5),
    P.ACCEL_NOISE: ParameterRange("", 10.0, 0.5),
}


@dataclass(frozen=True, slots=True)
class RigAxes:
    """The rectified axes of a calibration, in which its corrections are given.

    body_from_rect (3, 3): rotation of the rectified left camera; rect_from_cam (n, 3, 3): of each camera; baseline_m: 0 for one camera.
    """

    body_from_rect: Array
    rect_from_cam: Array
    baseline_m: float

    @classmethod
    def of(cls, rig: RigCalibration, rectifier: Rectifier) -> "RigAxes":
        """Return the axes to which `rectifier` rotates the cameras of `rig`."""
        body_from_rect = rectifier.body_from_cam[:3, :3]
        turned = np.array([body_from_rect.T @ camera.body_from_cam[:3, :3] for camera in rig.cameras])
        return cls(body_from_rect, turned, rectifier.camera.baseline_m if len(rig.cameras) > 1 else 0.0)


def corrected_rig(rig: RigCalibration, axes: RigAxes, theta: Array) -> RigCalibration:
    """Return `rig` with corrections theta of its first view: lenses, pair, mount, clocks. Theta (UNKNOWNS,) includes distortion."""
    left = _camera(rig.cameras[0], theta, 0)
    body_from_rect = axes.body_from_rect @ so3_exp(theta[INDEX[P.CAMERA_IMU_X] : INDEX[P.CAMERA_IMU_Z] + 1])
    shift = theta[INDEX[P.CAMERA_POSITION_X] : INDEX[P.CAMERA_POSITION_Z] + 1]
    place = rig.cameras[0].body_from_cam[:3, 3] + shift
    cameras = [replace(left, body_from_cam=se3(body_from_rect @ axes.rect_from_cam[0], place))]
    if axes.baseline_m > 0:
        right_in_rect, apart = right_camera(axes, theta)
        body_from_right = se3(body_from_rect @ right_in_rect, place + body_from_rect @ apart)
        cameras.append(replace(_camera(rig.cameras[1], theta, 1), body_from_cam=body_from_right))
    return replace(rig, cameras=(*cameras, *rig.cameras[len(cameras) :]))


def right_camera(axes: RigAxes, theta: Array) -> tuple[Array, Array]:
    """Return rotation (3, 3) rect_from_cam1 and position (3,) of the right camera in the rectified axes of the left one."""
    turn = so3_exp(theta[INDEX[P.PAIR_PITCH] : INDEX[P.PAIR_ROLL] + 1])
    direction = np.array([1.0, theta[INDEX[P.BASELINE_Y]], theta[INDEX[P.BASELINE_Z]]])
    length = axes.baseline_m * (1.0 + theta[INDEX[P.BASELINE]])
    return turn @ axes.rect_from_cam[1], direction * (length / np.linalg.norm(direction))


def with_distortion(distortion: Array, change: Array) -> Array:
    """Return the coefficients (k,) with a change (DISTORTION,) of the first ones; the others are fixed."""
    size = max(DISTORTION, len(distortion))
    return np.pad(distortion, (0, size - len(distortion))) + np.pad(change, (0, size - DISTORTION))


def _camera(camera: CameraCalibration, theta: Array, number: int) -> CameraCalibration:
    zoom = (1.0 + theta[INDEX[P.FOCAL]]) * (1.0 + theta[INDEX[P.FOCAL_RATIO]] if number else 1.0)
    shift = theta[[INDEX[P.PRINCIPAL_X], INDEX[P.PRINCIPAL_Y]]]
    distortion, lens = camera.distortion, theta[len(COLUMNS) :]
    if len(lens):
        change = lens[:DISTORTION] + (number - 0.5) * lens[DISTORTION : 2 * DISTORTION]
        distortion = with_distortion(distortion, change)
        shift = shift + number * lens[2 * DISTORTION :]
    intrinsics = np.concatenate([camera.intrinsics_px[:2] * zoom, camera.intrinsics_px[2:] + shift])
    offset_s = camera.imu_minus_cam_s + float(theta[INDEX[P.TIME_OFFSET]])
    return replace(camera, intrinsics_px=intrinsics, distortion=distortion, imu_minus_cam_s=offset_s)
