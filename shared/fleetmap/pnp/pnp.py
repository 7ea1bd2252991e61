"""Where one camera is, from points whose places are known: RANSAC, then robust least squares with covariance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3, transform_points
from fleetmap.pnp import p3p_ransac_kernels, pnp_kernels
from fleetmap.sensors.rectification import StereoCamera

_WIDTH = 4.0  # of the robust weight, in sigmas
_CONFIDENCE = 0.999  # that no camera has more votes than the one that was found
GATE_SQUARED = 11.345  # 0.99 of chi-square with 3 degrees of freedom: u, v, disparity


@dataclass(frozen=True, slots=True)
class PnpResult:
    """A solved camera.

    cam_from_source (4, 4); cov_rot_trans (6, 6) of a left perturbation in camera axes; inliers (N,); squared normalised
    residuals (N,).
    """

    cam_from_source: Array
    cov_rot_trans: Array
    inliers: NDArray[np.bool_]
    squared: Array


def refine_pnp(
    camera: StereoCamera, points_source: Array, pixels: Array, sigmas_px: Array, cam_from_source: Array,
    prior_information: Array | None = None, iterations: int = 10,
) -> PnpResult | None:  # fmt: skip
    """Robust least squares from a start; None where the points do not determine the camera.

    points_source (N, 3); pixels (N, 3) u_left v u_right (NaN none); sigmas_px (N, 2) of u and v, of the disparity.
    prior_information (6, 6) holds the start, rotation first, camera axes.
    """
    if len(points_source) == 0:
        return None
    intrinsics = np.array([camera.focal_px, camera.cx_px, camera.cy_px, camera.focal_px * camera.baseline_m])
    prior = np.zeros((6, 6)) if prior_information is None else np.ascontiguousarray(prior_information)
    rotation, translation = cam_from_source[:3, :3].copy(), cam_from_source[:3, 3].copy()
    points, measured = np.ascontiguousarray(points_source, np.float64), np.ascontiguousarray(pixels, np.float64)
    weights = 1.0 / np.ascontiguousarray(sigmas_px, np.float64)
    hessian, squared = np.empty((6, 6)), np.empty(len(points))
    solved = pnp_kernels.refine(
        rotation, translation, points, measured, weights, intrinsics, _WIDTH, prior, iterations, hessian, squared
    )
    if not solved:
        return None
    inliers = squared < GATE_SQUARED
    if inliers.sum() >= 4:  # once more on the inliers alone, so that no outlier leans on the result
        again = np.empty(int(inliers.sum()))
        solved = pnp_kernels.refine(
            rotation,
            translation,
            points[inliers],
            measured[inliers],
            weights[inliers],
            intrinsics,
            _WIDTH,
            prior,
            5,
            hessian,
            again,
        )
        if not solved:
            return None
        pnp_kernels.linearize(
            rotation, translation, points, measured, weights, intrinsics, _WIDTH, np.empty((6, 6)), np.empty(6), squared
        )
        inliers = squared < GATE_SQUARED
    return PnpResult(
        se3(rotation, translation), np.asarray(np.linalg.inv(hessian + prior + 1e-9 * np.eye(6))), inliers, squared
    )


def ransac_pnp(
    camera: StereoCamera,
    points_source: Array,
    pixels: Array,
    sigmas_px: Array,
    *,
    threshold_px: float,
    min_inliers: int,
    seed: int,
    iterations: int = 800,
) -> PnpResult | None:
    """As `refine_pnp` without a start: three-point RANSAC first, of so many iterations at most.

    None below min_inliers. Sources are named in the kernels.
    """
    if len(points_source) < max(min_inliers, 4):
        return None
    points, measured = np.ascontiguousarray(points_source, np.float64), np.ascontiguousarray(pixels[:, :2], np.float64)
    intrinsics = np.array([camera.focal_px, camera.cx_px, camera.cy_px, camera.focal_px * camera.baseline_m])
    rotation, translation = np.eye(3), np.zeros(3)
    draws = np.random.default_rng(seed).random((iterations, 3))
    votes = p3p_ransac_kernels.search(
        points, measured, intrinsics, threshold_px, draws, _CONFIDENCE, rotation, translation
    )
    if votes < min_inliers:
        return None
    start = se3(rotation, translation)
    off = np.linalg.norm(camera.pixel_from_point(transform_points(start, points))[:, :2] - measured, axis=1)
    index = np.flatnonzero(off < threshold_px)
    first = refine_pnp(camera, points_source[index], pixels[index], sigmas_px[index], start)
    if first is None:
        return None
    result = refine_pnp(camera, points_source, pixels, sigmas_px, first.cam_from_source)
    return result if result is not None and int(result.inliers.sum()) >= min_inliers else None


def pnp_with_rotation(
    camera: StereoCamera, points_source: Array, pixels: Array, sigmas_px: Array, cam_from_source_rotation: Array, *,
    threshold_px: float, min_inliers: int, rotation_sigma_rad: float,
) -> PnpResult | None:  # fmt: skip
    """As `ransac_pnp` where the rotation is nearly known (from the IMU).

    One correspondence proposes the translation. Needs depth in both views. Finds the place among far more wrong matches
    than three points can; none below min_inliers.
    """
    if len(points_source) < min_inliers:
        return None
    seen = camera.point_from_pixel(pixels[:, :2], pixels[:, 0] - pixels[:, 2])
    intrinsics = np.array([camera.focal_px, camera.cx_px, camera.cy_px, camera.focal_px * camera.baseline_m])
    translation = np.zeros(3)
    score = pnp_kernels.search_translation(
        np.ascontiguousarray(cam_from_source_rotation), np.ascontiguousarray(points_source), seen,
        np.ascontiguousarray(pixels[:, :2]), intrinsics, threshold_px, translation,
    )  # fmt: skip
    if score < min_inliers:
        return None
    prior = np.zeros((6, 6))
    prior[:3, :3] = np.eye(3) / rotation_sigma_rad**2
    start = se3(cam_from_source_rotation, translation)
    turned = points_source @ start[:3, :3].T + translation
    near = np.linalg.norm(camera.pixel_from_point(turned)[:, :2] - pixels[:, :2], axis=1) < threshold_px
    first = refine_pnp(camera, points_source[near], pixels[near], sigmas_px[near], start, prior)
    if first is None:
        return None
    result = refine_pnp(camera, points_source, pixels, sigmas_px, first.cam_from_source, prior)
    return result if result is not None and int(result.inliers.sum()) >= min_inliers else None
