"""Camera models: pixel_from_ray and ray_from_pixel for each. To add one: a file here, a line in CAMERA_MODELS, and one in _NAMES
for each of its names in calibration files. Parameters beyond fx, fy, cx and cy are its `distortion`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array
from fleetmap.sensors.cameras import equidistant, radial_tangential, spheres


class _Project(Protocol):
    def __call__(self, intrinsics_px: Array, distortion: Array, rays_cam: Array) -> Array: ...


class _Unproject(Protocol):
    def __call__(self, intrinsics_px: Array, distortion: Array, pixels: Array) -> Array: ...


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A lens model.

    pixel_from_ray(intrinsics_px (4,) fx fy cx cy, distortion (k,), rays_cam (N, 3)) -> (N, 2) px, NaN outside the lens's field of view.
    ray_from_pixel(intrinsics_px, distortion, pixels (N, 2)) -> (N, 3) unit rays, NaN where no ray maps to the pixel.
    core_lens(distortion) -> the coefficients in the core's order, and the x^2 + y^2 at which a radial-tangential image folds back.
    The core chooses the lens by their number: 8 are radial-tangential, 4 equidistant, 12 a sphere's.
    axis_scale(distortion) -> focal length on the optical axis, in fx and fy.
    fault(distortion) -> the parameter that no lens has, with its range; empty if all are possible.
    """

    pixel_from_ray: _Project
    ray_from_pixel: _Unproject
    core_lens: Callable[[Array], tuple[Array, float]]
    distortion_counts: tuple[int, ...]
    axis_scale: Callable[[Array], float] = lambda _: 1.0
    fault: Callable[[Array], str] = lambda _: ""


CAMERA_MODELS = {
    name: CameraModel(lens.pixel_from_ray, lens.ray_from_pixel, lens.core_lens, counts)
    for name, lens, counts in (
        ("radial-tangential", radial_tangential, (0, 4, 5, 8)),
        ("equidistant", equidistant, (4,)),
    )
} | {
    name: CameraModel(
        lens.pixel_from_ray, lens.ray_from_pixel, lens.core_lens, (lens.count,), lens.axis_scale, lens.fault
    )
    for name, lens in spheres.LENSES.items()
}

# Lens names of ROS, Kalibr, EuRoC, OpenCV and OpenVINS; in ROS an empty name means plumb_bob
_NAMES = {
    "plumb_bob": "radial-tangential",
    "radtan": "radial-tangential",
    "radial-tangential": "radial-tangential",
    "rational_polynomial": "radial-tangential",
    "": "radial-tangential",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
    **{name: name for name in spheres.LENSES},
}
_NO_PINHOLES = ("omni", "mei", "sphere", "unified", "eucm")  # even if their coefficients are zero
_NEXT_STEP = "calibrate with one of these, or record rectified images, or pass a calibration with --calibration FILE"


def lens_of(name: str, coefficients: Array, where: str) -> tuple[str, Array]:
    """Translate another program's lens name to a key of CAMERA_MODELS and its distortion; `where` is for error messages.

    Coefficients are in OpenCV's order. Zeros at their end are cut off, so that one lens has one form: ROS writes five or
    eight where four are known. CalibrationError for lenses that are not supported, for other counts and for values that are not finite.
    """
    name = name.lower()
    if not np.isfinite(coefficients).all():
        raise CalibrationError(
            f"{where}: distortion coefficients {coefficients.tolist()} are not finite; calibrate again"
        )
    if name not in _NAMES and (coefficients.any() or any(word in name for word in _NO_PINHOLES)):
        known = ", ".join(filter(None, _NAMES))
        raise CalibrationError(
            f"{where}: the lens model {name[:40]!r} is not supported, known are {known}; {_NEXT_STEP}"
        )
    counts = CAMERA_MODELS[_NAMES.get(name, "radial-tangential")].distortion_counts
    for count in counts:
        if len(coefficients) >= count and not coefficients[count:].any():
            return _NAMES.get(name, "radial-tangential"), coefficients[:count]
    more = "; thin prisms (9 to 12) and tilted sensors (13, 14) are not supported" if len(coefficients) > 8 else ""
    raise CalibrationError(
        f"{where}: {len(coefficients)} distortion coefficients {coefficients[:16].tolist()} for {name or 'plumb_bob'}, "
        f"which takes {' or '.join(map(str, counts))}{more}; {_NEXT_STEP}"
    )
