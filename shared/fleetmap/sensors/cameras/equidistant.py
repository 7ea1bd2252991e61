"""Equidistant fisheye k1 k2 k3 k4: the image radius is a polynomial of the angle. Source: Kannala and Brandt 2006, OpenCV's fisheye."""

import numpy as np

from fleetmap.geometry import Array

_ITERATIONS = 20


def _radius(distortion: Array, theta: Array) -> Array:
    k1, k2, k3, k4 = distortion
    t2 = theta * theta
    return np.asarray(theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))))


def _slope(distortion: Array, theta: Array) -> Array:
    k1, k2, k3, k4 = distortion
    t2 = theta * theta
    return np.asarray(1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4))))


def pixel_from_ray(intrinsics_px: Array, distortion: Array, rays_cam: Array) -> Array:
    """(N, 2) pixels of rays (N, 3); NaN for the direction straight back and where the polynomial folds."""
    fx, fy, cx, cy = intrinsics_px
    planar = np.hypot(rays_cam[:, 0], rays_cam[:, 1])
    theta = np.arctan2(planar, rays_cam[:, 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(planar > 1e-12, _radius(distortion, theta) / planar, 1.0 / rays_cam[:, 2])
    pixels = np.stack([fx * scale * rays_cam[:, 0] + cx, fy * scale * rays_cam[:, 1] + cy], axis=1)
    pixels[(_slope(distortion, theta) <= 0) | (theta > 3.1) | ~np.isfinite(scale)] = np.nan
    return pixels


def core_lens(distortion: Array) -> tuple[Array, float]:
    """See CameraModel."""
    return np.array(distortion, np.float64), np.inf


def ray_from_pixel(intrinsics_px: Array, distortion: Array, pixels: Array) -> Array:
    """(N, 3) unit rays of pixels (N, 2). Newton's method on the radius; NaN if no angle gives it."""
    fx, fy, cx, cy = intrinsics_px
    x, y = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    goal = np.hypot(x, y)
    theta = np.minimum(goal, np.pi)
    for _ in range(_ITERATIONS):
        with np.errstate(divide="ignore", invalid="ignore"):
            theta = theta - (_radius(distortion, theta) - goal) / _slope(distortion, theta)
    missed = ~((np.abs(_radius(distortion, theta) - goal) < 1e-9) & (theta >= 0) & (theta < np.pi))
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(goal > 1e-12, np.sin(theta) / goal, 1.0)
    rays = np.stack([x * scale, y * scale, np.cos(theta)], axis=1)
    rays[missed | (_slope(distortion, theta) <= 0)] = np.nan
    return rays
