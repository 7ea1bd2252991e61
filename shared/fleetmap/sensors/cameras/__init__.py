"""Camera models: pixel_from_ray and ray_from_pixel for each. To add one: a file here and a line in CAMERA_MODELS."""

from dataclasses import dataclass
from typing import Protocol

from fleetmap.geometry import Array
from fleetmap.sensors.cameras import equidistant, radial_tangential


class _Project(Protocol):
    def __call__(self, intrinsics_px: Array, distortion: Array, rays_cam: Array) -> Array: ...


class _Unproject(Protocol):
    def __call__(self, intrinsics_px: Array, distortion: Array, pixels: Array) -> Array: ...


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A lens model.

    pixel_from_ray(intrinsics_px (4,) fx fy cx cy, distortion (k,), rays_cam (N, 3)) -> (N, 2) px, NaN where the lens cannot see.
    ray_from_pixel(intrinsics_px, distortion, pixels (N, 2)) -> (N, 3) unit rays, NaN where no ray maps to the pixel.
    """

    pixel_from_ray: _Project
    ray_from_pixel: _Unproject
    distortion_counts: tuple[int, ...]


CAMERA_MODELS = {
    "radial-tangential": CameraModel(radial_tangential.pixel_from_ray, radial_tangential.ray_from_pixel, (0, 4, 5)),
    "equidistant": CameraModel(equidistant.pixel_from_ray, equidistant.ray_from_pixel, (4,)),
}
