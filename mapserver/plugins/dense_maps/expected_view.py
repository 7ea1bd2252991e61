"""Expected images of a camera at a pose, drawn from surfels."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.errors import CalibrationError, UsageError
from fleetmap.geometry import Array, Array32, Mask, se3_inverse
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.rectification import StereoCamera
from mapserver.plugins.dense_maps.exposure import lens_factor
from mapserver.plugins.dense_maps.surfel_map import Surfels

Image32 = NDArray[np.float32]
FAR_M = 40.0
RADIUS_EDGES = 1.2  # of a disc: more than half of the diagonal of a voxel's face
MOST_PIXELS = 1 << 21
_RIM = 0.1  # of the width: discs with a centre this far outside may reach in
_ALIKE_M, _ALIKE_RAD = 0.5, 0.3  # images this near to each other have the same exposure
_MOST_SQUARED = 1.0  # limit of the squared tangent of the angle to the axis for the lens model


@dataclass(frozen=True, slots=True)
class ExpectedView:
    """A picture (H, W) uint8, depths in m along the rays (H, W), NaN if unknown, and the mask of unknown pixels (H, W)."""

    picture: NDArray[np.uint8]
    depth_m: Array32
    unknown: Mask


def pinhole(camera: StereoCamera) -> CameraCalibration:
    """Return the left camera of a rectified pair, without its mount."""
    intrinsics = np.array([camera.focal_px, camera.focal_px, camera.cx_px, camera.cy_px])
    return CameraCalibration("radial-tangential", camera.width_px, camera.height_px, intrinsics, np.zeros(0), np.eye(4))


def resized(camera: CameraCalibration, width_px: int) -> CameraCalibration:
    """Return the same lens with smaller or larger pixels; pixel (0, 0) keeps its corner."""
    scale = width_px / camera.width_px
    fx, fy, cx, cy = camera.intrinsics_px
    intrinsics = np.array([fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5])
    return replace(camera, width_px=width_px, height_px=round(camera.height_px * scale), intrinsics_px=intrinsics)


def expected_view(surfels: Surfels, camera: CameraCalibration, map_from_cam: Array) -> ExpectedView:
    """Draw the image of `camera` at map_from_cam (4, 4), as bright as the survey's images. Unknown pixels are filled and marked.

    Raises UsageError for a picture that is too large and for an invalid pose.
    """
    if camera.width_px * camera.height_px > MOST_PIXELS:
        raise UsageError(
            f"a view of {camera.width_px} x {camera.height_px} px; the limit is {MOST_PIXELS} pixels, request fewer"
        )
    rotation = map_from_cam[:3, :3]
    if not np.isfinite(map_from_cam).all() or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise UsageError(f"invalid pose {np.round(map_from_cam[:3], 3).tolist()}; give a rotation and metres")
    rays, weight, colour, depth_m = _drawn(surfels, camera, map_from_cam, FAR_M)
    unknown = weight <= 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        colour, depth_m = colour / weight, depth_m / weight
        squared = (rays[..., 0] ** 2 + rays[..., 1] ** 2) / rays[..., 2] ** 2
    squared = np.nan_to_num(np.where(rays[..., 2] > 0, squared, _MOST_SQUARED), nan=0.0)
    colour *= lens_factor(np.minimum(squared, _MOST_SQUARED), np.array(surfels.falloff)) * brightness(
        surfels, map_from_cam
    )
    return ExpectedView(np.clip(np.round(filled(colour, unknown)), 0, 255).astype(np.uint8), depth_m, unknown)


def expected_depth(surfels: Surfels, camera: CameraCalibration, map_from_cam: Array, far_m: float) -> Image32:
    """Return (H, W) distances along the rays as of `expected_view`, of surfels up to far_m; NaN if unknown."""
    _, weight, _, depth_m = _drawn(surfels, camera, map_from_cam, far_m)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(depth_m / weight, np.float32)


def _drawn(
    surfels: Surfels, camera: CameraCalibration, map_from_cam: Array, far_m: float
) -> tuple[Array, Image32, Image32, Image32]:
    """Return the rays (H, W, 3) of a view, and weights, colours and depths (H, W) as of `draw_discs`."""
    rays, pixels_per_rad, cosine = _lens(
        camera.model, camera.width_px, camera.height_px, tuple(camera.intrinsics_px), tuple(camera.distortion)
    )
    cam_from_map = se3_inverse(map_from_cam)
    bends = camera.model != "radial-tangential" or camera.distortion.any()
    numbers, points, pixels = core.discs_before(
        surfels.points_map, surfels.normals, cam_from_map, cosine, far_m, camera.intrinsics_px * (not bends), camera.width_px,
        camera.height_px,
    )  # fmt: skip
    if bends:
        pixels = camera.pixel_from_ray(points)
        low, high = -_RIM * camera.width_px, np.array([camera.width_px, camera.height_px]) + _RIM * camera.width_px
        inside = ((pixels > low) & (pixels < high)).all(axis=1)
        numbers, points, pixels = numbers[inside], points[inside], pixels[inside]
    discs = numbers, points, pixels, cam_from_map, surfels.normals, surfels.levels, surfels.greys
    return rays, *core.draw_discs(*discs, far_m, RADIUS_EDGES, rays, pixels_per_rad)


def filled(picture: Array32, unknown: Mask) -> Array32:
    """Fill unknown pixels of the picture (H, W) smoothly from their neighbours; grey without any. Source: Gortler et al. 1996."""
    known = (~unknown).astype(np.float32)
    if not known.any():
        return np.full(picture.shape, 128.0, np.float32)
    values, weights = [np.where(unknown, np.float32(0.0), picture)], [known]
    while max(values[-1].shape) > 1:
        size = (-(-values[-1].shape[1] // 2), -(-values[-1].shape[0] // 2))
        weights.append(np.asarray(cv2.pyrDown(weights[-1], dstsize=size), np.float32))
        values.append(np.asarray(cv2.pyrDown(values[-1], dstsize=size), np.float32))
    coarse = values[-1] / np.maximum(weights[-1], 1e-6)
    for value, weight in zip(values[-2::-1], weights[-2::-1], strict=True):
        above = np.asarray(cv2.resize(coarse, value.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
        share = np.minimum(weight, 1.0)
        coarse = share * value / np.maximum(weight, 1e-6) + (1 - share) * above
    return np.where(unknown, coarse, picture)


def brightness(surfels: Surfels, map_from_cam: Array) -> float:
    """Return the brightness of the drives' images near this place with this heading, as exposed by their camera."""
    if not len(surfels.exposures):
        return 1.0
    off_m = np.linalg.norm(surfels.exposures[:, :3] - map_from_cam[:3, 3], axis=1)
    turn_rad = np.arccos(np.clip(surfels.exposures[:, 3:6] @ map_from_cam[:3, 2], -1.0, 1.0))
    apart = (off_m / _ALIKE_M) ** 2 + (turn_rad / _ALIKE_RAD) ** 2
    weights = np.exp(-0.5 * (apart - apart.min()))
    return float(np.exp((weights * surfels.exposures[:, 6]).sum() / weights.sum()))


@lru_cache(maxsize=8)
def _lens(
    model: str, width_px: int, height_px: int, intrinsics: tuple[float, ...], distortion: tuple[float, ...]
) -> tuple[Array, Array32, float]:
    """Return rays (H, W, 3), the finest pixels per radian around each (H, W), and the cosine of the cone that contains all rays."""
    camera = CameraCalibration(model, width_px, height_px, np.array(intrinsics), np.array(distortion), np.eye(4))
    v, u = np.mgrid[0:height_px, 0:width_px].astype(np.float64)
    rays = camera.ray_from_pixel(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(height_px, width_px, 3)
    finest = np.zeros((height_px, width_px))
    for axis in (0, 1):
        step = np.linalg.norm(np.diff(rays, axis=axis), axis=2)
        per_rad = 1.0 / np.maximum(np.where(np.isfinite(step), step, np.inf), 1e-6)
        for part in (slice(None, -1), slice(1, None)):
            where = (part, slice(None)) if axis == 0 else (slice(None), part)
            finest[where] = np.maximum(finest[where], per_rad)
    if not np.isfinite(rays).any() or not finest.any():
        raise CalibrationError(
            f"no pixel of the {model} camera {width_px} x {height_px} has a ray; check its calibration"
        )
    finest[finest == 0] = finest[finest > 0].min()
    return rays, finest.astype(np.float32), float(np.nanmin(rays[..., 2])) - 0.05
