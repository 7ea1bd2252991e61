"""Values of bundle adjustment: the problem, its settings, its result, and the noise of its observations by the residuals.

Perturbations, here and in every information and covariance: rotation first, in the axes of the target frame, about the source's origin. For
map_from_body that is R <- Exp(rot) R, p <- p + trans, both in map axes; for i_from_j in the axes of i.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from fleetmap.geometry import AnyArray, Array, Mask, se3_inverse
from fleetmap.inertial import Preintegrated
from mapserver.survey.rig import Rig
from mapserver.survey.state import PriorTerm, RelativeTerm


class MotionPrior(NamedTuple):
    """Prior of keyframe k's motion and biases; a sigma of inf means no prior.

    mean (9,): velocity in map m/s, gyro bias rad/s, accelerometer bias m/s^2; sigma (9,).
    """

    k: int
    mean: Array
    sigma: Array


@dataclass
class InertialTerms:
    """Motion between keyframes by the IMU.

    motions (K, 9): see KeyframeMotion. edges: (i, j, Preintegrated), j after i. fixed (K,): keyframes with fixed motion and biases, none
    if absent.
    """

    motions: Array
    edges: list[tuple[int, int, Preintegrated]]
    priors: list[MotionPrior] = field(default_factory=list)
    fixed: Mask | None = None


class ImageRows(NamedTuple):
    """Whitened rows of M observations: residuals (M, 4), derivatives by point (M, 4, 3) and calibration (M, 4, C).

    positions_map (K, 3): of the keyframes' bodies at exposure. shares (4,): factors on the weights of an observation's rows.
    """

    residuals: Array
    by_point: Array
    by_calibration: Array
    positions_map: Array
    shares: Array = np.ones(4)


class SelfCalibration(NamedTuple):
    """A calibration that is estimated too: theta (C,), with weight (C,) 1 / sigma^2 about zero.

    ways_m (R, 3): derivative of the translation of each relative pose by theta[scale]. rows: the images at map_from_body, motions,
    points and theta, with derivatives if the last argument is True; they replace the camera and its pixels.
    """

    theta: Array
    weight: Array
    ways_m: Array
    scale: int
    rows: Callable[[Array, Array, Array, Array, bool], ImageRows]


@dataclass
class BundleProblem:
    """K keyframes, N landmarks, M observations.

    map_from_body (K, 4, 4); fixed (K,): fixed keyframes. With gauge "yaw_position" a fixed keyframe (by default the first one)
    keeps its yaw and position, and gravity determines its roll and pitch. points_map (N, 3). obs_pixels (M,
    3): u_left, v, u_right, NaN without a right image. obs_sigma_px (M, 2): of u_left and v, and of the disparity u_left
    - u_right; the three are taken as independent. points_held: only keyframes move. obs_keyframe, obs_camera, obs_landmark (M,): see
    Landmarks.
    """

    rig: Rig
    map_from_body: Array
    fixed: Mask
    points_map: Array
    obs_keyframe: AnyArray
    obs_camera: AnyArray
    obs_landmark: AnyArray
    obs_pixels: Array
    obs_sigma_px: Array
    inertial: InertialTerms | None = None
    relative: list[RelativeTerm] = field(default_factory=list)
    priors: list[PriorTerm] = field(default_factory=list)
    gauge: Literal["pose", "yaw_position"] = "pose"
    points_held: bool = False
    calibration: SelfCalibration | None = None

    @property
    def map_from_cams(self) -> Array:
        """(K, V, 4, 4)."""
        return self.rig.map_from_cams(self.map_from_body)

    def observed(self, keep: Mask) -> "BundleProblem":
        """Return the problem with the observations to keep (M,)."""
        return replace(self, **{name: getattr(self, name)[keep] for name in OBSERVED})


OBSERVED = ("obs_keyframe", "obs_camera", "obs_landmark", "obs_pixels", "obs_sigma_px")


@dataclass(frozen=True)
class BundleResult:
    """The optimum.

    map_from_body (K, 4, 4), points_map (N, 3); motions (K, 9), None without inertial terms. costs: half the robust sum of squares at the
    start and after every accepted step. squared_sigmas (M,): each observation's squared residual in sigmas, in the problem's order, huge
    for points behind the camera.
    """

    map_from_body: Array
    points_map: Array
    motions: Array | None
    costs: list[float]
    squared_sigmas: Array


def continued(problem: BundleProblem, result: BundleResult) -> BundleProblem:
    """Return `problem` at the values of `result`."""
    moved = replace(problem, map_from_body=result.map_from_body, points_map=result.points_map)
    if problem.inertial is not None and result.motions is not None:
        moved.inertial = replace(problem.inertial, motions=result.motions)
    return moved


_CLASSES = 8
_CHUNK = 50_000  # observations; poses and points take 0.3 kB each
_LEAST_OBSERVATIONS = 100  # of a class: its median is then accurate to 15 %
# Medians of |x| and of the length of a pair for normal noise of sigma 1
_MEDIAN_OF_ONE, _MEDIAN_OF_TWO = 0.6745, 1.1774
_LEAST_SIGMA_PX = 0.01  # finer than any matching
_EFFICIENT_HUBER = 1.345  # noise sigmas from which the cost is linear: 95 % efficient on normal noise (Huber 1964)


def measured_sigmas(problem: BundleProblem, huber_sigmas: float) -> Array:
    """Return (M, 2) sigmas of pixels and disparities for a robust cost that is linear from huber_sigmas.

    Too large stated sigmas make robust costs ineffective: at depth edges disparities are too large, never too small (foreground
    fattening), and errors within one stated sigma bias the scale. The noise differs between cameras, so the survey measures it.
    Observations are grouped into classes by their stated sigma. Each class is scaled by one factor: the ratio of the median
    residual at the problem's values to the stated sigma. The factor also corrects for a cost that
    is linear from elsewhere than 1.345 noise sigmas. Classes of less than 100 observations are unchanged. Exact ones get a least sigma.
    """
    pixel, disparity = _residuals(problem)
    widened = _EFFICIENT_HUBER / huber_sigmas
    claimed = problem.obs_sigma_px
    columns = [_by_class(pixel / _MEDIAN_OF_TWO, claimed[:, 0]), _by_class(disparity / _MEDIAN_OF_ONE, claimed[:, 1])]
    return widened * np.maximum(np.stack(columns, axis=1), _LEAST_SIGMA_PX)


def _residuals(problem: BundleProblem) -> tuple[Array, Array]:
    """Return lengths (M,) of the residuals of pixel and disparity, NaN if absent."""
    cam_from_map = se3_inverse(problem.map_from_cams)
    pixel, disparity = np.empty((2, len(problem.obs_keyframe)))
    for first in range(0, len(pixel), _CHUNK):
        rows = slice(first, first + _CHUNK)
        own = cam_from_map[problem.obs_keyframe[rows], problem.obs_camera[rows]]
        points = problem.points_map[problem.obs_landmark[rows]]
        seen = np.einsum("mij,mj->mi", own[:, :3, :3], points) + own[:, :3, 3]
        off = problem.rig.camera.pixel_from_point(seen) - problem.obs_pixels[rows]
        pixel[rows], disparity[rows] = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 0] - off[:, 2])
    return pixel, disparity


def _by_class(noise: Array, claimed: Array) -> Array:
    """Return (M,) the stated sigmas times the median ratio of noise to stated sigma in each class."""
    known = np.isfinite(noise)
    count = min(_CLASSES, int(known.sum()) // _LEAST_OBSERVATIONS)
    if count == 0:
        return claimed
    limits = np.unique(np.quantile(claimed[known], np.arange(1, count) / count))
    number, sigmas = np.searchsorted(limits, claimed), claimed.copy()
    for each in range(len(limits) + 1):
        own = number == each
        if (own & known).sum() >= _LEAST_OBSERVATIONS // 2:
            sigmas[own] *= np.median(noise[own & known] / claimed[own & known])
    return sigmas
