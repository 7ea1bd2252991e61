"""Values of bundle adjustment: the problem, its settings and its result.

Perturbations, here and in every information and covariance: rotation first, in the axes of the target frame, about the source's origin. For
map_from_body that is R <- Exp(rot) R, p <- p + trans, both in map axes; for i_from_j in the axes of i.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array
from fleetmap.inertial import Preintegrated
from mapserver.survey.rig import Rig
from mapserver.survey.state import PriorTerm, RelativeTerm


@dataclass(frozen=True)
class MotionPrior:
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
    fixed: NDArray[np.bool_] | None = None


class ImageRows(NamedTuple):
    """Whitened rows of M observations: residuals (M, 4), derivatives by point (M, 4, 3) and calibration (M, 4, C).

    positions_map (K, 3): of the keyframes' bodies at exposure.
    """

    residuals: Array
    by_point: Array
    by_calibration: Array
    positions_map: Array


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
    fixed: NDArray[np.bool_]
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

    def observed(self, keep: NDArray[np.bool_]) -> "BundleProblem":
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
