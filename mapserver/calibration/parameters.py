"""Parameters of a rig's calibration that a recording can show, and the corrected rig.

All are corrections to the calibration that a recording came with: zero where that is right. Axes of the pair are the rectified ones of
that calibration: x along the baseline, y down, z ahead.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Self

import numpy as np

from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.rectification import Rectifier


class CalibrationParameter(StrEnum):
    """Estimated parameters, by name. Shares are true / given - 1.

    prior_sigma: of the error of a careless calibration. useful_sigma: above it an estimate is useless: the error that displaces a point at
    3 m by about 1 cm, or the image by half a pixel. least_sigma: systematic error outside the adjustment. warn_above: error that costs
    3 cm; fail_above: error of another rig. anew_above: a correction that changes the matches: the images are rectified and tracked again.
    """

    unit: str
    prior_sigma: float
    useful_sigma: float
    least_sigma: float
    warn_above: float
    fail_above: float
    anew_above: float

    BASELINE = "baseline", "", 0.3, 0.01, 1.5e-3, 3e-3, 0.03, 0.02
    FOCAL = "focal length", "", 0.3, 0.005, 7e-4, 3e-3, 0.03, 0.005
    FOCAL_RATIO = "focal ratio", "", 0.05, 0.002, 2e-4, 1e-3, 0.03, 0.002
    PRINCIPAL_X = "principal point x", "px", 40.0, 2.0, 1.5, 4.0, 30.0, 3.0
    PRINCIPAL_Y = "principal point y", "px", 40.0, 2.0, 1.5, 4.0, 30.0, 3.0
    PAIR_PITCH = "pair pitch", "rad", 0.03, 5e-4, 2.5e-4, 1e-3, 7e-3, 0.002
    PAIR_YAW = "pair yaw", "rad", 0.03, 5e-4, 2.5e-4, 4e-4, 7e-3, 0.002
    PAIR_ROLL = "pair roll", "rad", 0.03, 1e-3, 3e-4, 1.5e-3, 7e-3, 0.002
    BASELINE_Y = "baseline direction y", "rad", 0.02, 5e-3, 5e-3, 0.02, 0.1
    BASELINE_Z = "baseline direction z", "rad", 0.02, 5e-3, 5e-3, 0.02, 0.1
    CAMERA_IMU_X = "camera to IMU x", "rad", 0.1, 3e-3, 1.5e-3, 5e-3, 0.1, 0.02
    CAMERA_IMU_Y = "camera to IMU y", "rad", 0.1, 3e-3, 1.5e-3, 5e-3, 0.1, 0.02
    CAMERA_IMU_Z = "camera to IMU z", "rad", 0.1, 3e-3, 1.5e-3, 5e-3, 0.1, 0.02
    CAMERA_POSITION_X = "camera position x", "m", 0.03, 0.01, 0.01, 0.03, 0.3
    CAMERA_POSITION_Y = "camera position y", "m", 0.03, 0.01, 0.01, 0.03, 0.3
    CAMERA_POSITION_Z = "camera position z", "m", 0.03, 0.01, 0.01, 0.03, 0.3
    TIME_OFFSET = "time offset", "s", 0.05, 2e-3, 5e-4, 2e-3, np.inf, 0.005
    # Tyres wear and deform under load: half a per cent is the accuracy of a robot's odometry without calibration
    WHEEL_SCALE = "wheel scale", "", 0.005, 0.005, 5e-3, 0.02
    GYRO_NOISE = "gyro noise", "", 10.0, 0.5, 0.5, 20.0
    ACCEL_NOISE = "accelerometer noise", "", 10.0, 0.5, 0.5, 20.0

    def __new__(cls, name: str, *row: Any) -> Self:
        """Make the member of a row; limits that it leaves out are infinite."""
        member = str.__new__(cls, name)
        member._value_ = name
        vars(member).update(zip(cls.__annotations__, [*row, np.inf, np.inf], strict=False))
        return member


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
# By unit: factor to the displayed unit, and number of digits
SHOWN = {
    "": (100.0, "%", 2),
    "rad": (float(np.degrees(1.0)), "degrees", 3),
    "s": (1e3, "ms", 1),
    "m": (1e3, "mm", 0),
    "px": (1.0, "px", 2),
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
    place = rig.cameras[0].body_from_cam[:3, 3] + theta[INDEX[P.CAMERA_POSITION_X] : INDEX[P.CAMERA_POSITION_Z] + 1]
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
