"""The pose of one camera from points with known positions: RANSAC, then robust least squares with covariance."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, Indices, Mask
from fleetmap.sensors.rectification import StereoCamera

_WIDTH = 4.0  # of the robust weight (Geman-McClure), in sigmas
_CONFIDENCE = 0.999  # confidence that the camera found has the most votes
GATE_SQUARED = 11.345  # 0.99 of chi-square with 3 degrees of freedom: u, v, disparity
ITERATIONS = 10, 5  # on all, and on the inliers
REFINEMENT = _WIDTH, GATE_SQUARED, ITERATIONS


@dataclass(frozen=True, slots=True)
class Correspondences:
    """N points_source (N, 3) and the pixels (N, 3) u_left v u_right (NaN none) of their observations.

    sigmas_px (N, 2) of u and v, of the disparity.
    """

    camera: StereoCamera
    points_source: Array
    pixels: Array
    sigmas_px: Array

    def __len__(self) -> int:
        return len(self.points_source)

    def take(self, rows: Mask | Indices) -> "Correspondences":
        """Select a subset."""
        return Correspondences(self.camera, self.points_source[rows], self.pixels[rows], self.sigmas_px[rows])


@dataclass(frozen=True)
class PnpResult:
    """A solved camera.

    cam_from_source (4, 4); information (6, 6) on a left perturbation in camera axes; inliers (N,); squared normalised
    residuals (N,).
    """

    cam_from_source: Array
    information: Array
    inliers: Mask
    squared: Array

    @cached_property
    def cov_rot_trans(self) -> Array:
        """(6, 6) covariance of the perturbation, computed on demand."""
        return np.asarray(np.linalg.inv(self.information + 1e-9 * np.eye(6)))


def refine_pnp(
    matches: Correspondences, cam_from_source: Array, prior_information: Array | None = None
) -> PnpResult | None:
    """Robust least squares from an initial pose; None if the points do not determine the camera.

    prior_information (6, 6) ties the result to the initial pose, rotation first, camera axes.
    """
    if len(matches) == 0:
        return None
    prior = None if prior_information is None else np.ascontiguousarray(prior_information)
    return _result(core.refine_pnp(*_sightings(matches), np.ascontiguousarray(cam_from_source), prior))


def ransac_pnp(
    matches: Correspondences, *, threshold_px: float, min_inliers: int, seed: int, iterations: int = 800
) -> PnpResult | None:
    """As `refine_pnp` without an initial pose: three-point RANSAC first, with at most the given iterations.

    None below min_inliers. Sources are named in the core.
    """
    if len(matches) < max(min_inliers, 4):
        return None
    draws = np.random.default_rng(seed).random((iterations, 3))
    return _result(core.ransac_pnp(*_sightings(matches), threshold_px, min_inliers, draws, _CONFIDENCE))


def pnp_with_rotation(
    matches: Correspondences,
    cam_from_source_rotation: Array,
    *,
    threshold_px: float,
    min_inliers: int,
    rotation_sigma_rad: float,
) -> PnpResult | None:
    """As `ransac_pnp` with a nearly known rotation (3, 3) (from the IMU).

    One correspondence proposes the translation. Needs depth in both images. Finds the pose among far more wrong matches
    than three points can; none below min_inliers.
    """
    known = np.ascontiguousarray(cam_from_source_rotation), rotation_sigma_rad
    return _result(core.pnp_with_rotation(*_sightings(matches), threshold_px, min_inliers, *known))


def _sightings(matches: Correspondences) -> tuple[Array, Array, Array, Array, tuple[float, float, tuple[int, int]]]:
    return (
        np.ascontiguousarray(matches.points_source, np.float64),
        np.ascontiguousarray(matches.pixels, np.float64),
        1.0 / np.ascontiguousarray(matches.sigmas_px, np.float64),
        matches.camera.lens,
        REFINEMENT,
    )


def _result(solved: tuple[Array, Array, Array] | None) -> PnpResult | None:
    if solved is None:
        return None
    cam_from_source, information, squared = solved
    return PnpResult(cam_from_source, information, squared < GATE_SQUARED, squared)
