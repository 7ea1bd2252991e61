"""Mapping of a camera's pixels to rays, prepared for the painter: pinhole planes and, for a lens, a look-up into them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array, so3_exp
from fleetmap.sensors.calibration import CameraCalibration

_WIDEST_TANGENT = 2.5  # a single plane for rays further out than this (68 degrees) would be too large
_DIFFERENCE_PX = 0.5
_PLANE_SCALE = 0.85  # of the lens' focal length: shading is exact anyway, only edges are sampled a little more coarsely
_TURNS = [
    so3_exp(np.pi / 2 * np.array(axis)) for axis in ((0.0, 0.0, 0.0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))
]


@dataclass(frozen=True, slots=True)
class Plane:
    """A painted pinhole plane. cam_from_plane (3, 3). pinhole (6,): fx fy cx cy width height.

    rays (H, W, 4): xn yn of the camera's pixels and their change per pixel, 1e6 for those that another plane shows; empty for a pinhole.
    """

    cam_from_plane: Array
    pinhole: Array
    rays: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Optics:
    """The planes of a camera, the one in front first; a fisheye beyond the widest tangent has four more around it.

    vignetting (H, W): cos^3 of the angle to the axis (a fast lens loses less than cos^4); of half the angle for a fisheye with more planes.
    """

    planes: tuple[Plane, ...]
    vignetting: NDArray[np.float32]


def make_optics(camera: CameraCalibration) -> Optics:
    """The optics of a calibrated camera. Raises CalibrationError if no pixel has a ray that can be painted."""
    height, width = camera.height_px, camera.width_px
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    if camera.model == "radial-tangential" and not np.any(camera.distortion):
        fx, fy, cx, cy = camera.intrinsics_px
        pinhole = np.array([fx, fy, cx, cy, width, height])
        squared = ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2
        plane = Plane(np.eye(3), pinhole, np.zeros((0, 0, 4), np.float32))
        return Optics((plane,), _vignetting(squared))
    step = _DIFFERENCE_PX
    shifts = (0, 0), (step, 0), (-step, 0), (0, step), (0, -step)
    pixels = (np.stack([u + du, v + dv], axis=-1).reshape(-1, 2) for du, dv in shifts)
    around = [camera.ray_from_pixel(shifted).reshape(height, width, 3) for shifted in pixels]
    front, unseen = _tangents(around, np.eye(3))
    if unseen.all():
        raise CalibrationError(
            f"no pixel of the {camera.model} lens with intrinsics {camera.intrinsics_px.tolist()} has a ray"
        )
    if not (unseen & np.isfinite(around).all((0, 3))).any():
        front[unseen] = 1e6
        vignetting = _vignetting(front[..., 0] ** 2 + front[..., 1] ** 2)
        return Optics((_plane(camera, np.eye(3), front, unseen),), vignetting)
    nearest = np.argmax(np.stack([around[0] @ turn[:, 2] for turn in _TURNS]), axis=0)
    planes = []
    for number, turn in enumerate(_TURNS):
        tangents, unseen = _tangents(around, turn)
        unseen |= nearest != number
        if not unseen.all():
            planes.append(_plane(camera, turn, tangents, unseen))
    half = np.nan_to_num(2.0 / (1.0 + around[0][..., 2]), nan=1e6)
    return Optics(tuple(planes), _vignetting(half - 1.0))


def _tangents(around: list[Array], cam_from_plane: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(H, W, 4) as in Plane of the rays at pixels, right, left, below and above of them; True for pixels that the plane does not show."""
    turned = (rays @ cam_from_plane for rays in around)
    here, right, left, below, above = (
        rays[..., :2] / np.where(rays[..., 2:] > 1e-3, rays[..., 2:], np.nan) for rays in turned
    )
    tangents = np.stack([here[..., 0], here[..., 1], (right - left)[..., 0], (below - above)[..., 1]], axis=-1)
    is_seen = np.isfinite(tangents).all(-1) & (np.abs(here) <= _WIDEST_TANGENT).all(-1)
    return tangents, np.asarray(~is_seen)


def _plane(camera: CameraCalibration, cam_from_plane: Array, tangents: Array, unseen: NDArray[np.bool_]) -> Plane:
    fx, fy = (_PLANE_SCALE * float(value) for value in camera.focal_px)
    seen = tangents[~unseen]
    margin = 2.0
    low_x, low_y = float(seen[:, 0].min()) * fx - margin, float(seen[:, 1].min()) * fy - margin
    plane_width = int(np.ceil(float(seen[:, 0].max()) * fx + margin - low_x))
    plane_height = int(np.ceil(float(seen[:, 1].max()) * fy + margin - low_y))
    pinhole = np.array([fx, fy, -low_x, -low_y, plane_width, plane_height])
    return Plane(cam_from_plane, pinhole, np.where(unseen[..., None], 1e6, tangents).astype(np.float32))


def _vignetting(squared_tangent: Array) -> NDArray[np.float32]:
    return np.asarray((1.0 + squared_tangent) ** -1.5, np.float32)
