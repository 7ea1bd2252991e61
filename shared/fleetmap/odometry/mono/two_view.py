"""Relative motion of two images of one camera up to scale, and the points that both see."""

from dataclasses import dataclass

import cv2
import numpy as np

from fleetmap.geometry import Array, Mask, midpoints, se3
from fleetmap.sensors.rectification import StereoCamera

_INLIER_PX, _SCORED_PX = 1.0, 3.0  # of RANSAC, and of the score
_RIVAL_SHARE = 0.75  # a second solution that explains at least this share of the best one makes the motion ambiguous


@dataclass(frozen=True, slots=True)
class TwoView:
    """b_from_a (4, 4) with a translation of length 1; points_a (N, 3) in those lengths, NaN for outliers.

    parallax_rad: median angle between the two rays of the inliers.
    """

    b_from_a: Array
    points_a: Array
    inliers: Mask
    parallax_rad: float


def two_view_motion(camera: StereoCamera, pixels_a: Array, pixels_b: Array, *, seed: int) -> TwoView | None:
    """The motion with which most matched pixels (N, 2) agree; None without one, or if two motions fit equally well.

    Candidates come from the essential matrix and from a homography (a flat scene has both); each is scored by the points that it
    puts in front of both cameras and near their pixels. Sources: Nister 2004 (essential matrix), Malis and Vargas 2007 (homography).
    """
    if len(pixels_a) < 8:
        return None
    scored = [
        _scored(camera, b_from_a, pixels_a, pixels_b) for b_from_a in _candidates(camera, pixels_a, pixels_b, seed)
    ]
    best = max(scored, key=lambda found: int(found.inliers.sum()), default=None)
    if best is None or not best.inliers.any():
        return None
    rivals = [rival for rival in scored if rival.b_from_a[:3, 3] @ best.b_from_a[:3, 3] < 0.9]
    return None if any(rival.inliers.sum() > _RIVAL_SHARE * best.inliers.sum() for rival in rivals) else best


def _candidates(camera: StereoCamera, pixels_a: Array, pixels_b: Array, seed: int) -> list[Array]:
    a, b = np.ascontiguousarray(pixels_a, np.float64), np.ascontiguousarray(pixels_b, np.float64)
    cv2.setRNGSeed(seed)
    found: list[Array] = []
    essential, _ = cv2.findEssentialMat(a, b, camera.matrix, cv2.RANSAC, 0.999, _INLIER_PX)
    if essential is not None and essential.shape == (3, 3):
        first, second, direction = cv2.decomposeEssentialMat(essential)
        found += [
            se3(np.asarray(rotation, np.float64), np.asarray(sign * direction.ravel(), np.float64))
            for rotation in (first, second)
            for sign in (1.0, -1.0)
        ]
    homography, _ = cv2.findHomography(a, b, cv2.RANSAC, 1.5 * _INLIER_PX)
    if homography is not None:
        _, rotations, directions, _ = cv2.decomposeHomographyMat(homography, camera.matrix)
        for rotation, direction in zip(rotations, directions, strict=True):
            length = float(np.linalg.norm(direction))
            if length > 1e-3:
                found.append(se3(np.asarray(rotation, np.float64), np.asarray(direction.ravel() / length, np.float64)))
    return found


def _scored(camera: StereoCamera, b_from_a: Array, pixels_a: Array, pixels_b: Array) -> TwoView:
    points, parallax = triangulate_pair(camera, b_from_a, pixels_a, pixels_b)
    seen = points @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    off_a = np.linalg.norm(camera.pixel_from_point(points)[:, :2] - pixels_a, axis=1)
    off_b = np.linalg.norm(camera.pixel_from_point(seen)[:, :2] - pixels_b, axis=1)
    with np.errstate(invalid="ignore"):
        inliers = (off_a < _SCORED_PX) & (off_b < _SCORED_PX)
    points = np.where(inliers[:, None], points, np.nan)
    return TwoView(b_from_a, points, inliers, float(np.median(parallax[inliers])) if inliers.any() else 0.0)


def triangulate_pair(camera: StereoCamera, b_from_a: Array, pixels_a: Array, pixels_b: Array) -> tuple[Array, Array]:
    """Points (N, 3) in camera a midway between the two rays, and the angles (N,) between them; NaN for parallel rays."""
    rays_a = rays_from_pixels(camera, pixels_a)
    rays_b = rays_from_pixels(camera, pixels_b) @ b_from_a[:3, :3]  # in the axes of a
    points, cosines = midpoints(rays_a, rays_b, -b_from_a[:3, :3].T @ b_from_a[:3, 3])
    return points, np.arccos(np.clip(cosines, -1.0, 1.0))


def rays_from_pixels(camera: StereoCamera, pixels: Array) -> Array:
    """(N, 3) unit rays in the camera's axes."""
    rays = np.column_stack([(pixels[:, :2] - [camera.cx_px, camera.cy_px]) / camera.focal_px, np.ones(len(pixels))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
