"""Pinhole with radial-tangential distortion k1 k2 p1 p2 [k3 [k4 k5 k6]]; without distortion if the coefficients are empty.

The radial factor is (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6). Sources: Brown 1966; OpenCV's order and its
rational model.
"""

from functools import lru_cache

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array

Lens = tuple[float, float, float, float, float, float, float, float]  # k1 k2 p1 p2 k3 k4 k5 k6


def _coefficients(distortion: Array) -> Lens:
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(np.asarray(distortion, np.float64), (0, 8 - len(distortion))).tolist()
    return k1, k2, p1, p2, k3, k4, k5, k6


def _distort(distortion: Array, x: Array, y: Array) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3, k4, k5, k6 = _coefficients(distortion)
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@lru_cache(maxsize=16)
def _radial_limit(lens: Lens) -> float:
    """Largest r^2 up to which the distorted radius still grows; beyond it the image folds back. The same in every frame."""
    k1, k2, _, _, k3, k4, k5, k6 = lens
    above, below = np.poly1d([k3, k2, k1, 1.0]), np.poly1d([k6, k5, k4, 1.0])
    # d/dr of r above(r^2) / below(r^2), times below^2, as a polynomial in r^2
    slope = above * below + np.poly1d([2.0, 0.0]) * (above.deriv() * below - above * below.deriv())
    roots = np.concatenate([slope.roots, below.roots])
    real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
    return float(real.min()) if len(real) else np.inf


def pixel_from_ray(intrinsics_px: Array, distortion: Array, rays_cam: Array) -> Array:
    """(N, 2) pixels of rays (N, 3); NaN behind the camera and where the polynomial is past its fold."""
    fx, fy, cx, cy = intrinsics_px
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = rays_cam[:, 0] / rays_cam[:, 2], rays_cam[:, 1] / rays_cam[:, 2]
        seen = (rays_cam[:, 2] > 1e-9) & (x * x + y * y < _radial_limit(_coefficients(distortion)))
        distorted_x, distorted_y = _distort(distortion, x, y)
    pixels = np.stack([fx * distorted_x + cx, fy * distorted_y + cy], axis=1)
    pixels[~seen] = np.nan
    return pixels


def core_lens(distortion: Array) -> tuple[Array, float]:
    """See CameraModel."""
    lens = _coefficients(distortion)
    return np.array(lens), _radial_limit(lens)


def ray_from_pixel(intrinsics_px: Array, distortion: Array, pixels: Array) -> Array:
    """(N, 3) unit rays of pixels (N, 2). Newton's method with a numeric Jacobian; NaN if it does not converge to the pixel."""
    fx, fy, cx, cy = intrinsics_px
    goal_x, goal_y = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    x, y = core.undistort(np.array(_coefficients(distortion)), goal_x, goal_y)
    back_x, back_y = _distort(distortion, x, y)
    limit = _radial_limit(_coefficients(distortion))
    missed = ~((np.hypot(back_x - goal_x, back_y - goal_y) < 1e-7) & (x * x + y * y < limit))
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays[missed] = np.nan
    return np.asarray(rays)
