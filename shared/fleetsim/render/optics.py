"""Mapping of a camera's pixels to rays, prepared for the painter: a pinhole plane and, for a lens, a look-up into it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array
from fleetmap.sensors.calibration import CameraCalibration

_WIDEST_TANGENT = 2.5  # rays further out than this (68 degrees) stay black: the pinhole plane would be too large
_DIFFERENCE_PX = 0.5
_PLANE_SCALE = 0.85  # of the lens' focal length: shading is exact anyway, only edges are sampled a little more coarsely


@dataclass(frozen=True, slots=True)
class Optics:
    """pinhole (6,): fx fy cx cy width height of the painted plane.

    rays (H, W, 4): xn yn and their change per pixel; empty for a pinhole.

    vignetting (H, W): cos^3 of the angle to the axis (a fast lens loses less than cos^4).
    """

    height_px: int
    width_px: int
    pinhole: Array
    rays: NDArray[np.float32]
    vignetting: NDArray[np.float32]


def make_optics(camera: CameraCalibration) -> Optics:
    """The optics of a calibrated camera. Raises CalibrationError if no pixel has a ray that can be painted."""
    height, width = camera.height_px, camera.width_px
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    if camera.model == "radial-tangential" and not np.any(camera.distortion):
        fx, fy, cx, cy = camera.intrinsics_px
        pinhole = np.array([fx, fy, cx, cy, width, height])
        squared = ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2
        return Optics(height, width, pinhole, np.zeros((0, 0, 4), np.float32), _vignetting(squared))
    xn, yn = _normalised(camera, u, v)
    right, left = _normalised(camera, u + _DIFFERENCE_PX, v)[0], _normalised(camera, u - _DIFFERENCE_PX, v)[0]
    down, up = _normalised(camera, u, v + _DIFFERENCE_PX)[1], _normalised(camera, u, v - _DIFFERENCE_PX)[1]
    rays = np.stack([xn, yn, right - left, down - up], axis=-1)
    unseen = ~np.isfinite(rays).all(-1) | (np.abs(rays[..., :2]) > _WIDEST_TANGENT).any(-1)
    if unseen.all():
        raise CalibrationError(
            f"no pixel of the {camera.model} lens with intrinsics {camera.intrinsics_px.tolist()} has a ray"
        )
    fx, fy = (_PLANE_SCALE * float(value) for value in camera.focal_px)
    seen = rays[~unseen]
    margin = 2.0
    low_x, low_y = float(seen[:, 0].min()) * fx - margin, float(seen[:, 1].min()) * fy - margin
    plane_width = int(np.ceil(float(seen[:, 0].max()) * fx + margin - low_x))
    plane_height = int(np.ceil(float(seen[:, 1].max()) * fy + margin - low_y))
    rays[unseen] = 1e6
    pinhole = np.array([fx, fy, -low_x, -low_y, plane_width, plane_height])
    return Optics(height, width, pinhole, rays.astype(np.float32), _vignetting(rays[..., 0] ** 2 + rays[..., 1] ** 2))


def _normalised(camera: CameraCalibration, u: Array, v: Array) -> tuple[Array, Array]:
    """x/z and y/z (H, W) of pixels; NaN where no ray in front of the camera maps to the pixel."""
    rays = camera.ray_from_pixel(np.stack([u.ravel(), v.ravel()], axis=1))
    z = np.where(rays[:, 2] > 1e-3, rays[:, 2], np.nan)
    return (rays[:, 0] / z).reshape(u.shape), (rays[:, 1] / z).reshape(u.shape)


def _vignetting(squared_tangent: Array) -> NDArray[np.float32]:
    return np.asarray((1.0 + squared_tangent) ** -1.5, np.float32)
