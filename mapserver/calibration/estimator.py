"""Self-calibrating bundle adjustment: poses, landmarks, motion and the calibration itself, with its covariance.

The survey's bundle adjustment solves; the calibration is the border of its system, and its covariance the inverse of the border's
Schur complement. The noise scales are estimated too: each kind of measurement is weighted by its own residuals.
Sources: Triggs et al. 2000, Bundle adjustment, a modern synthesis; Förstner and Wrobel 2016, Photogrammetric computer vision, variance
components.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fleetmap.core import BundleSolver
from fleetmap.geometry import Array, so3_exp
from fleetmap.sensors.calibration import ImuNoise
from mapserver.calibration.image_rows import Measured, Observations, image_rows
from mapserver.calibration.motion_rows import CalibrationData, MotionState, body_rates, inertial_edges, wheel_edges
from mapserver.calibration.parameters import COLUMNS, INDEX, UNKNOWNS, CalibrationParameter
from mapserver.survey.bundle.bundle_adjustment import solver_of
from mapserver.survey.bundle.problem import BundleProblem, ImageRows, InertialTerms, MotionPrior, SelfCalibration
from mapserver.survey.rig import Rig
from mapserver.survey.settings import BundleSettings
from mapserver.survey.state import PriorTerm

Rows = Callable[..., ImageRows]
SETTINGS = BundleSettings(max_iterations=12, huber_sigmas=3.0, cutoff_sigmas=8.0, lambda_start=1e-6)
_ROUNDS = 5  # each re-estimates the noise scales and integrates the samples at the new biases
_TOLERANCE = 1e-5
_ROUGH_TOLERANCE = 1e-2  # while the noise scales are unknown
_SLOPE_ROUNDS = 2  # rounds that compute the lenses' derivatives: at the given calibration, and near the result
_SHARE = 0.01  # increase of one kind's weight, to compute its redundancy by differences
_FIRST_SIGMAS = np.array([0.1] * 3 + [3.0] * 3)  # fixes the unobservable heading and position of the first keyframe
_BIAS_SIGMAS = np.repeat([10.0, 0.1, 0.5], 3)  # of the first keyframe: velocity m/s, gyro rad/s, accelerometer m/s^2
_LOOSE_SIGMAS = np.array([10.0] * 3 + [1000.0] * 3)  # of keyframes without observations
_MEDIAN_NORM = 1.83  # of four normal rows
_SMALLEST_SCALE, _LARGEST_SCALE = 0.05, 100.0


@dataclass(frozen=True)
class ErrorScales:
    """Factors on the sigmas of pixels, disparities, row differences (4,: two of pixels), of gyro, accelerometer and wheels."""

    images: Array = field(default_factory=lambda: np.ones(4))
    gyro: float = 1.0
    accel: float = 1.0
    wheel: float = 1.0

    def noise(self, given: ImuNoise) -> ImuNoise:
        """Return the IMU's noise with these factors; the random walks of its biases are unchanged."""
        gyro, accel = given.gyro_noise_radps_rthz * self.gyro, given.accel_noise_mps2_rthz * self.accel
        return replace(given, gyro_noise_radps_rthz=gyro, accel_noise_mps2_rthz=accel)

    def corrected(self, squares: Array, redundancy: Array) -> "ErrorScales":
        """Return the scales at which each kind's sum of squared residuals equals its redundancy (6,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sqrt(squares / redundancy)
        ratio = np.where(np.isfinite(ratio) & (redundancy > 3.0), ratio, 1.0)
        limited = np.clip(
            ratio * [*self.images[1:], self.gyro, self.accel, self.wheel], _SMALLEST_SCALE, _LARGEST_SCALE
        )
        pixel, disparity, row, gyro, accel, wheel = limited.tolist()
        return ErrorScales(np.array([pixel, pixel, disparity, row]), gyro, accel, wheel)


@dataclass(frozen=True)
class Adjusted:
    """The optimum: theta (C,) with information (C, C), priors included; the state; the noise scales, and the relative sigmas of
    those; lens (UNKNOWNS - C,): corrections of the distortion. focal_by_lens: change of the focal length by radial distortion beyond the
    error allowed for the given lens."""

    theta: Array
    information: Array
    state: MotionState
    scales: ErrorScales
    gyro_sigma: float
    accel_sigma: float
    observations: int
    lens: Array
    focal_by_lens: float


def adjust(data: CalibrationData) -> Adjusted:
    """Return the calibration that fits `data` best."""
    problem = Problem(data)
    theta, state = np.zeros(UNKNOWNS), data.start
    scales, redundancy = problem.first_scales(), np.zeros(6)
    for round_number in range(_ROUNDS):
        last = round_number + 1 == _ROUNDS
        if round_number < _SLOPE_ROUNDS:
            problem.slopes = problem.seen.measured_slopes(theta)
        problem.prepare(state, theta, scales)
        theta, state = problem.descend(theta, state, _TOLERANCE if last else _ROUGH_TOLERANCE)
        # Redundancies follow from what was observed, and from scales only by their ratios: every other round is enough, the last one for
        # the IMU, whose noise is reported.
        asked = (3, 4) if last else range(6) if round_number % 2 == 0 else ()
        squares, redundancy = problem.variance_components(theta, state, redundancy, asked)
        if not last:
            scales = scales.corrected(squares, redundancy)
    information = problem.calibration_information(theta, state)
    sigmas = np.where(redundancy > 3.0, (2.0 * np.maximum(redundancy, 1e-9)) ** -0.5, np.inf)  # as shares of the scales
    gyro, accel = sigmas[3:5].tolist()
    seen = int(np.isfinite(problem.seen.row_sigmas[:, 0]).sum())
    own = len(COLUMNS)
    lens = np.linalg.solve(information[own:, own:], information[own:, :own])
    reported = information[:own, :own] - information[:own, own:] @ lens
    excess = np.maximum(np.abs(theta[own:]) - data.lens_sigmas, 0.0)[:2]
    by_lens = np.linalg.solve(information[:own, :own], information[:own, own : own + 2])
    focal_by_lens = float(np.linalg.norm(by_lens[INDEX[CalibrationParameter.FOCAL]] * excess))
    return Adjusted(theta[:own], reported, state, scales, gyro, accel, seen, theta[own:], focal_by_lens)


def prior_information() -> Array:
    """Return (C,) information of the calibration that came with the recording."""
    return np.array([p.prior_sigma**-2 for p in COLUMNS])


class Problem:
    """One stretch, with samples integrated at given biases and noise scales."""

    def __init__(self, data: CalibrationData) -> None:
        self.data, self.seen = data, Observations.of(data)
        self.prior = np.concatenate([prior_information(), data.lens_sigmas**-2.0])
        given = np.zeros(UNKNOWNS)
        self.measured = given, self.seen.measured(given)  # the last theta, and its pixels
        self.slopes: Measured | None = None  # derivatives by the calibration
        # Weak priors fix the gauge.
        first = _FIRST_SIGMAS if data.is_inertial else 1e-3 * _FIRST_SIGMAS
        self.priors = [
            PriorTerm(k, map_from_body, np.diag((_LOOSE_SIGMAS if k else first) ** -2.0))
            for k, map_from_body in enumerate(data.start.map_from_body)
        ]

    def prepare(self, state: MotionState, theta: Array, scales: ErrorScales) -> None:
        """Integrate the samples and set the noise scales."""
        offset_s = float(theta[INDEX[CalibrationParameter.TIME_OFFSET]])
        self.scales, self.base_offset_s = scales, offset_s
        given = self.data.calibration.imu
        self.inertial = [] if given is None else inertial_edges(self.data, state, offset_s, scales.noise(given))
        self.wheels = wheel_edges(self.data, state, offset_s, scales.wheel)
        self.rates_map = body_rates(self.data, state, offset_s)

    def rows(self, map_from_body: Array, motions: Array, points: Array, theta: Array, derivatives: bool) -> ImageRows:
        """Return the images' rows at the body's poses at exposure: states are at the time offset used to integrate the samples."""
        late_s = float(theta[INDEX[CalibrationParameter.TIME_OFFSET]]) - self.base_offset_s
        if self.data.is_inertial and late_s != 0.0:
            turns = np.array([so3_exp(late_s * rate) for rate in self.rates_map])
            map_from_body[:, :3, 3] += late_s * motions[:, :3]
            map_from_body[:, :3, :3] = turns @ map_from_body[:, :3, :3]
        state = MotionState(map_from_body, motions if self.data.is_inertial else self.data.start.motions, points)
        slopes = (self.rates_map, self.slopes) if derivatives else ()
        if not np.array_equal(theta, self.measured[0]):
            self.measured = theta, self.seen.measured(theta)
        return image_rows(self.seen, self.data, state, *self.measured, self.scales.images, *slopes)

    def bundle(self, theta: Array, state: MotionState, shares: Array, rows: Rows | None = None) -> BundleProblem:
        """Return the adjustment at theta and `state`, by default with its own rows; each kind of motion is weighted by shares (3,)."""
        rotation, motion, way = shares.tolist()
        inertial, data = None, self.data
        if data.is_inertial:
            edges = [(e.first, e.first + 1, e.believed(rotation, motion)) for e in self.inertial]
            known = MotionPrior(0, np.concatenate([data.start.motions[0, :3], np.zeros(6)]), _BIAS_SIGMAS)
            inertial = InertialTerms(state.motions, edges, [known])
        return BundleProblem(
            rig=Rig.of_one(data.rectifier.camera, data.rectifier.body_from_cam),
            map_from_body=state.map_from_body,
            fixed=np.zeros(len(data.stamps_ns), np.bool_),
            points_map=state.points_map,
            obs_keyframe=data.obs_keyframe,
            obs_camera=np.zeros_like(data.obs_keyframe),
            obs_landmark=data.obs_landmark,
            obs_pixels=data.obs_pixels[:, :3],
            obs_sigma_px=data.obs_sigma_px[:, :2],
            inertial=inertial,
            relative=[edge.term(way) for edge in self.wheels],
            priors=self.priors,
            calibration=SelfCalibration(
                theta,
                self.prior,
                np.array([edge.way_m for edge in self.wheels]).reshape(-1, 3),
                INDEX[CalibrationParameter.WHEEL_SCALE],
                rows or self.rows,
            ),
        )

    def descend(self, theta: Array, state: MotionState, tolerance: float) -> tuple[Array, MotionState]:
        """Return the optimum near theta and `state`."""
        solver = solver_of(self.bundle(theta, state, np.ones(3)), SETTINGS)
        solver.optimize(SETTINGS.lambda_start, SETTINGS.max_iterations, tolerance)
        motions = solver.motions() if self.data.is_inertial else state.motions
        return solver.calibration(), MotionState(solver.map_from_body(), motions, solver.points_map())

    def calibration_information(self, theta: Array, state: MotionState) -> Array:
        """Return (C, C) information of the calibration with everything else marginalised."""
        lower, _ = solver_of(self.bundle(theta, state, np.ones(3)), SETTINGS).reduced(0.0)
        root = np.linalg.cholesky(lower)[-UNKNOWNS:, -UNKNOWNS:]
        return np.asarray(root @ root.T)

    def first_scales(self) -> ErrorScales:
        """Return scales wide enough for the median observation: with a wrong calibration all residuals are large at first."""
        rows = image_rows(self.seen, self.data, self.data.start, *self.measured, np.ones(4)).residuals
        norm = np.linalg.norm(rows[np.isfinite(self.seen.row_sigmas[:, 0])], axis=1)
        return ErrorScales(np.full(4, max(1.0, float(np.median(norm)) / _MEDIAN_NORM) if len(norm) else 1.0))

    def variance_components(
        self, theta: Array, state: MotionState, known: Array, asked: Sequence[int]
    ) -> tuple[Array, Array]:
        """(6,) sums of squares of pixels, disparities, row differences, gyro, accelerometer and wheels along the way, and redundancies:
        measured of those asked, of the others as known (6,).

        A redundancy is n - tr(H^-1 H_g) of n residuals that give H_g to the information H (Förstner and Wrobel 2016); the trace is how log
        det H grows with the share of H_g.
        """
        rows = self.rows(state.map_from_body.copy(), state.motions, state.points_map, theta, True)
        norm = np.linalg.norm(rows.residuals, axis=1)
        weight = np.where(
            norm > SETTINGS.cutoff_sigmas, 0.0, SETTINGS.huber_sigmas / np.maximum(norm, SETTINGS.huber_sigmas)
        )
        counted = (weight > 0.0) & (np.abs(rows.by_point).sum(axis=2) > 0.0).T
        sums = (weight * (rows.residuals**2).T).sum(axis=1)
        felt = np.array([edge.residual(state) for edge in self.inertial]).reshape(-1, 15)
        scale = float(theta[INDEX[CalibrationParameter.WHEEL_SCALE]])
        rolled = np.array([edge.residual(state, scale)[0] for edge in self.wheels])
        kinds = felt[:, :3], felt[:, 3:9], rolled
        squares = np.array([sums[0] + sums[1], *sums[2:], *((kind**2).sum() for kind in kinds)])
        numbers = np.array([counted[:2].sum(), counted[2].sum(), counted[3].sum(), *(kind.size for kind in kinds)])
        redundancy, weighted = known.copy(), rows

        def solver(motions: Array) -> BundleSolver:
            return solver_of(self.bundle(theta, state, motions, lambda *_: weighted), SETTINGS)

        if not asked:
            return squares, redundancy
        as_is = solver(np.ones(3))
        alone = as_is.log_determinant()
        for kind in (kind for kind in asked if numbers[kind]):
            shares = 1.0 + _SHARE * (np.arange(6) == kind)
            weighted = rows._replace(shares=shares[[0, 0, 1, 2]])
            grown = (as_is if kind < 3 else solver(shares[3:])).log_determinant()
            redundancy[kind] = numbers[kind] - (grown - alone) / np.log1p(_SHARE)
        return squares, redundancy
