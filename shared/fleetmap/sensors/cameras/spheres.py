"""Fisheyes by spheres: Kalibr's omni, eucm and ds, each followed by radial-tangential distortion.

A ray (x, y, z) of length d1 is moved along the axis to w = z + xi d1, and meets the plane at m = (x, y) / (a d2 + b w), where
d2 = sqrt(beta (x^2 + y^2) + w^2). m is then distorted as the points of a pinhole's plane z = 1. `distortion` is k1 k2 p1 p2 and

    omni           xi        a = xi, b = 1, unmoved           unified model, Mei and Rives 2007
    eucm           alpha beta   a = alpha, b = 1 - alpha, unmoved   Khomutenko, Garcia and Martinet 2016
    double-sphere  xi alpha  a = alpha, b = 1 - alpha         Usenko, Demmel and Cremers 2018

Rays behind the camera have pixels as long as m grows with their angle to the axis: w > -d2 min(a, b) / max(a, b). The inverse is that
of the last two papers, for any a and b. `intrinsics_px` are Kalibr's: on the axis the focal length is fx / ((a + b) (1 + xi)).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array
from fleetmap.sensors.cameras import radial_tangential

PLANE = 4  # coefficients of the plane's distortion, before those of the shape
_Shape = tuple[float, float, float, float]  # xi beta a b


@dataclass(frozen=True, slots=True)
class SphereLens:
    """One of the three models.

    kalibr: its name in camchains, where its parameters stand before fx. ranges: the closed interval of each parameter. shape: xi, beta,
    a and b of the parameters.
    """

    kalibr: str
    ranges: dict[str, tuple[float, float]]
    shape: Callable[..., _Shape]

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return PLANE + len(self.ranges)

    def fault(self, distortion: Array) -> str:
        """See CameraModel."""
        for value, (name, (low, high)) in zip(distortion[PLANE:].tolist(), self.ranges.items(), strict=True):
            if not low <= value <= high:
                return f"{name} of {self.kalibr} is {value:g}, outside of {low:g} to {high:g}"
        return ""

    def pixel_from_ray(self, intrinsics_px: Array, distortion: Array, rays_cam: Array) -> Array:
        """(N, 2) pixels of rays (N, 3); NaN beyond the angle up to which the image grows."""
        xi, beta, a, b = self.shape(*distortion[PLANE:])
        x, y, z = rays_cam.T
        squared = x * x + y * y
        w = z + xi * np.sqrt(squared + z * z)
        d2 = np.sqrt(beta * squared + w * w)
        with np.errstate(divide="ignore", invalid="ignore"):
            plane = np.stack([x, y, a * d2 + b * w], axis=1) / (a * d2 + b * w)[:, None]
        pixels = radial_tangential.pixel_from_ray(intrinsics_px, distortion[:PLANE], plane)
        pixels[~(w * max(a, b) > -d2 * min(a, b))] = np.nan
        return pixels

    def ray_from_pixel(self, intrinsics_px: Array, distortion: Array, pixels: Array) -> Array:
        """(N, 3) unit rays of pixels (N, 2); NaN outside the image of the sphere."""
        xi, beta, a, b = self.shape(*distortion[PLANE:])
        ahead = radial_tangential.ray_from_pixel(intrinsics_px, distortion[:PLANE], pixels)
        x, y = (ahead[:, :2] / ahead[:, 2:]).T
        squared = x * x + y * y
        rest = 1 - a * a * beta * squared
        with np.errstate(divide="ignore", invalid="ignore"):
            w = rest / (b + np.sqrt(b * b + (a * a - b * b) * rest))
            scale = (w * xi + np.sqrt(w * w + (1 - xi * xi) * squared)) / (w * w + squared)
        return np.stack([scale * x, scale * y, scale * w - xi], axis=1)

    def core_lens(self, distortion: Array) -> tuple[Array, float]:
        """See CameraModel."""
        plane, limit = radial_tangential.core_lens(distortion[:PLANE])
        return np.concatenate([plane, self.shape(*distortion[PLANE:])]), limit

    def axis_scale(self, distortion: Array) -> float:
        """See CameraModel."""
        xi, _, a, b = self.shape(*distortion[PLANE:])
        return float(1.0 / ((a + b) * (1.0 + xi)))


# Beyond xi = 1 of ds the second sphere turns the image inside out; at -1 the focal length on the axis is infinite.
LENSES = {
    "omni": SphereLens("omni", {"xi": (0.0, np.inf)}, lambda xi: (0.0, 1.0, xi, 1.0)),
    "eucm": SphereLens("eucm", {"alpha": (0.0, 1.0), "beta": (0.0, np.inf)}, lambda a, beta: (0.0, beta, a, 1.0 - a)),
    "double-sphere": SphereLens("ds", {"xi": (-0.99, 1.0), "alpha": (0.0, 1.0)}, lambda xi, a: (xi, 1.0, a, 1.0 - a)),
}
