"""The pose of one camera from points with known positions: RANSAC, then robust least squares with covariance."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array, se3, transform_points
from fleetmap.pnp import p3p_ransac_kernels
from fleetmap.sensors.rectification import StereoCamera

_WIDTH = 4.0  # of the robust weight (Geman-McClure), in sigmas
_CONFIDENCE = 0.999  # that no camera has more votes than the one that was found
GATE_SQUARED = 11.345  # 0.99 of chi-square with 3 degrees of freedom: u, v, disparity
ITERATIONS = 10, 5  # on all, and on the inliers
REFINEMENT = _WIDTH, GATE_SQUARED, ITERATIONS


@dataclass(frozen=True, slots=True)
class Correspondences:
    """N points_source (N, 3) and the pixels (N, 3) u_left v u_right (NaN none) where a camera sees them.

    sigmas_px (N, 2) of u and v, of the disparity.
    """

    camera: StereoCamera
    points_source: Array
    pixels: Array
    sigmas_px: Array

    def __len__(self) -> int:
        return len(self.points_source)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Correspondences":
        """Some of them."""
        return Correspondences(self.camera, self.points_source[rows], self.pixels[rows], self.sigmas_px[rows])


@dataclass(frozen=True)
class PnpResult:
    """A solved camera.

    cam_from_source (4, 4); information (6, 6) on a left perturbation in camera axes; inliers (N,); squared normalised
    residuals (N,).
    """

    cam_from_source: Array
    information: Array
    inliers: NDArray[np.bool_]
    squared: Array

    @cached_property
    def cov_rot_trans(self) -> Array:
        """(6, 6) of the perturbation; not every caller needs it."""
        return np.asarray(np.linalg.inv(self.information + 1e-9 * np.eye(6)))


def refine_pnp(
    matches: Correspondences, cam_from_source: Array, prior_information: Array | None = None
) -> PnpResult | None:
    """Robust least squares from a start; None where the points do not determine the camera.

    prior_information (6, 6) holds the start, rotation first, camera axes.
    """
    if len(matches) == 0:
        return None
    solved = core.refine_pnp(
        np.ascontiguousarray(cam_from_source),
        np.ascontiguousarray(matches.points_source, np.float64),
        np.ascontiguousarray(matches.pixels, np.float64),
        1.0 / np.ascontiguousarray(matches.sigmas_px, np.float64),
        matches.camera.lens,
        REFINEMENT,
        None if prior_information is None else np.ascontiguousarray(prior_information),
    )
    if solved is None:
        return None
    refined, information, squared = solved
    return PnpResult(refined, information, squared < GATE_SQUARED, squared)


def ransac_pnp(
    matches: Correspondences, *, threshold_px: float, min_inliers: int, seed: int, iterations: int = 800
) -> PnpResult | None:
    """As `refine_pnp` without a start: three-point RANSAC first, of so many iterations at most.

    None below min_inliers. Sources are named in the kernels.
    """
    if len(matches) < max(min_inliers, 4):
        return None
    points = np.ascontiguousarray(matches.points_source, np.float64)
    measured = np.ascontiguousarray(matches.pixels[:, :2], np.float64)
    rotation, translation, camera = np.eye(3), np.zeros(3), matches.camera
    draws = np.random.default_rng(seed).random((iterations, 3))
    votes = p3p_ransac_kernels.search(
        points, measured, camera.lens, threshold_px, draws, _CONFIDENCE, rotation, translation
    )
    if votes < min_inliers:
        return None
    start = se3(rotation, translation)
    off = np.linalg.norm(camera.pixel_from_point(transform_points(start, points))[:, :2] - measured, axis=1)
    return _refined_twice(matches, off < threshold_px, start, None, min_inliers)


def pnp_with_rotation(
    matches: Correspondences,
    cam_from_source_rotation: Array,
    *,
    threshold_px: float,
    min_inliers: int,
    rotation_sigma_rad: float,
) -> PnpResult | None:
    """As `ransac_pnp` where the rotation is nearly known (from the IMU).

    One correspondence proposes the translation. Needs depth in both views. Finds the pose among far more wrong matches
    than three points can; none below min_inliers.
    """
    if len(matches) < min_inliers:
        return None
    camera, points, pixels = matches.camera, matches.points_source, matches.pixels
    seen = camera.point_from_pixel(pixels[:, :2], pixels[:, 0] - pixels[:, 2])
    rotation, measured = np.ascontiguousarray(cam_from_source_rotation), np.ascontiguousarray(pixels[:, :2])
    score, translation = core.search_translation(
        rotation, np.ascontiguousarray(points), seen, measured, camera.lens, threshold_px
    )
    if score < min_inliers:
        return None
    prior = np.zeros((6, 6))
    prior[:3, :3] = np.eye(3) / rotation_sigma_rad**2
    start = se3(cam_from_source_rotation, translation)
    off = np.linalg.norm(camera.pixel_from_point(points @ start[:3, :3].T + translation)[:, :2] - pixels[:, :2], axis=1)
    return _refined_twice(matches, off < threshold_px, start, prior, min_inliers)


def _refined_twice(
    matches: Correspondences, near: NDArray[np.bool_], start: Array, prior: Array | None, min_inliers: int
) -> PnpResult | None:
    """Least squares on the matches near a start, then on all; None below min_inliers."""
    first = refine_pnp(matches.take(near), start, prior)
    result = None if first is None else refine_pnp(matches, first.cam_from_source, prior)
    return result if result is not None and int(result.inliers.sum()) >= min_inliers else None
