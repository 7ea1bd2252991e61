"""Self-calibrating bundle adjustment: poses, landmarks, motion and the calibration itself, with its covariance.

Landmarks are eliminated by the Schur complement; calibration is a dense border of what is left, and its covariance the inverse of that
border's own Schur complement. The sizes of the errors are estimated too: each kind of measurement is believed as far as its own residuals
allow. Sources: Triggs et al. 2000, Bundle adjustment, a modern synthesis; Förstner and Wrobel 2016, Photogrammetric computer vision,
variance components.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg

from fleetmap import core
from fleetmap.geometry import Array, so3_exp
from fleetmap.sensors.calibration import ImuNoise
from mapserver.calibration.image_rows import ImageRows, Observations, image_residuals, image_rows, robust_cost
from mapserver.calibration.motion_rows import (
    MOTION,
    ROTATION,
    WHEEL,
    InertialEdge,
    Rows,
    WheelEdge,
    body_rates,
    inertial_edges,
    inertial_rows,
    wheel_edges,
    wheel_rows,
)
from mapserver.calibration.parameters import COLUMNS, INDEX, RANGES, UNKNOWNS, CalibrationParameter
from mapserver.calibration.problem import CalibrationData, MotionState

_ROUNDS = 5  # in each the sizes of the errors are estimated anew, and the samples integrated at the new biases
_MAX_STEPS = 12
_TOLERANCE = 1e-5
_ROUGH_TOLERANCE = 1e-2  # where the sizes of the errors are not known yet
_SLOPE_ROUNDS = (
    2  # in which the lenses' derivatives are taken: at the given calibration, and near the one that is found
)
_DRAWS = 2  # of random errors, for what residuals of each kind should be
_FIRST_SIGMAS = np.array([0.1] * 3 + [3.0] * 3)  # holds what nothing observes: heading and place of the first keyframe
_BIAS_SIGMAS = np.repeat([10.0, 0.1, 0.5], 3)  # of the first keyframe: velocity m/s, gyro rad/s, accelerometer m/s^2
_LOOSE_SIGMAS = np.array([10.0] * 3 + [1000.0] * 3)  # of keyframes that see nothing
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
        """The IMU's noise with these factors; the walks of its biases as they are."""
        gyro, accel = given.gyro_noise_radps_rthz * self.gyro, given.accel_noise_mps2_rthz * self.accel
        return replace(given, gyro_noise_radps_rthz=gyro, accel_noise_mps2_rthz=accel)


@dataclass(frozen=True)
class Adjusted:
    """The optimum: theta (C,) with information (C, C), priors included; the state; the scales of the errors, and
    their sigmas' shares; lens (UNKNOWNS - C,): corrections of the distortion. focal_by_lens: by how much radial distortion beyond what the
    given lens may be off by moves the focal length."""

    theta: Array
    information: Array
    state: MotionState
    scales: ErrorScales
    gyro_sigma: float
    accel_sigma: float
    observations: int
    lens: Array
    focal_by_lens: float


class BorderedLandmarks(NamedTuple):
    """Of N landmarks: inverse (N, 3, 3) of their information, rhs (N, 3), coupling (N, 3, C) to the calibration."""

    inverse: Array
    rhs: Array
    coupling: Array


@dataclass(frozen=True)
class _System:
    """Normal equations at one point: information (D, D), rhs (D,), and what is needed for the landmarks."""

    information: Array
    rhs: Array
    images: ImageRows
    edges: list[Rows]
    eliminated: BorderedLandmarks


def adjust(data: CalibrationData) -> Adjusted:
    """The calibration that explains `data` best."""
    problem = _Problem(data)
    theta, state = np.zeros(UNKNOWNS), data.start
    scales = problem.first_scales(theta, state)
    information, sigmas = np.diag(problem.prior), (np.inf, np.inf)
    for round_number in range(_ROUNDS):
        last = round_number + 1 == _ROUNDS
        if round_number < _SLOPE_ROUNDS:
            problem.slopes = problem.seen.measured_slopes(theta)
        problem.prepare(state, theta, scales)
        theta, state = problem.descend(theta, state, _TOLERANCE if last else _ROUGH_TOLERANCE)
        system = problem.system(theta, state)
        if last:
            information, sigmas = problem.calibration_information(system), problem.scale_sigmas(system)
        else:
            scales = problem.measured_scales(system)
    seen = int(np.isfinite(problem.seen.row_sigmas[:, 0]).sum())
    own = len(COLUMNS)
    lens = np.linalg.solve(information[own:, own:], information[own:, :own])
    reported = information[:own, :own] - information[:own, own:] @ lens
    excess = np.maximum(np.abs(theta[own:]) - data.lens_sigmas, 0.0)[:2]
    by_lens = np.linalg.solve(information[:own, :own], information[:own, own : own + 2])
    focal_by_lens = float(np.linalg.norm(by_lens[INDEX[CalibrationParameter.FOCAL]] * excess))
    return Adjusted(theta[:own], reported, state, scales, *sigmas, seen, theta[own:], focal_by_lens)


def prior_information() -> Array:
    """(C,) of the calibration that came with the recording."""
    return np.array([RANGES[p].prior_sigma ** -2 for p in COLUMNS])


class _Problem:
    """One stretch, with the samples integrated at some biases and the scales of the errors."""

    def __init__(self, data: CalibrationData) -> None:
        self.data, self.seen = data, Observations.of(data)
        self.prior = np.concatenate([prior_information(), data.lens_sigmas**-2.0])
        self.stride = 15 if data.is_inertial else 6
        self.count = len(data.stamps_ns)
        self.size = self.stride * self.count + UNKNOWNS
        marks = len(data.start.points_map)
        self.starts = np.searchsorted(data.obs_landmark, np.arange(marks + 1))
        self.keyframes = data.obs_keyframe.astype(np.int64)
        self.slopes = np.zeros((len(data.obs_keyframe), 4, UNKNOWNS))  # of what is measured, by the calibration

    def prepare(self, state: MotionState, theta: Array, scales: ErrorScales) -> None:
        """Integrates the samples and takes over the scales."""
        offset_s = float(theta[INDEX[CalibrationParameter.TIME_OFFSET]])
        self.scales, self.base_offset_s = scales, offset_s
        given, self.origin = self.data.calibration.imu, state
        self.inertial: list[InertialEdge] = []
        if given is not None:
            self.inertial = inertial_edges(self.data, state, offset_s, scales.noise(given))
        self.wheels: list[WheelEdge] = wheel_edges(self.data, state, offset_s)
        self.rates_map = body_rates(self.data, state, offset_s)

    def _at_exposure(self, theta: Array, state: MotionState) -> MotionState:
        """The body when the images were taken: the states are those at the offset for which the samples were integrated."""
        late_s = float(theta[INDEX[CalibrationParameter.TIME_OFFSET]]) - self.base_offset_s
        if late_s == 0.0:
            return state
        moved = state.map_from_body.copy()
        moved[:, :3, 3] += late_s * state.motions[:, :3]
        for k in range(self.count):
            moved[k, :3, :3] = so3_exp(late_s * self.rates_map[k]) @ moved[k, :3, :3]
        return replace(state, map_from_body=moved)

    def _edges(self, theta: Array, state: MotionState) -> list[Rows]:
        scale = float(theta[INDEX[CalibrationParameter.WHEEL_SCALE]])
        rolled = [wheel_rows(edge, state, scale, self.stride) for edge in self.wheels]
        rows = [inertial_rows(edge, state) for edge in self.inertial]
        return rows + [_divided(each, self.scales.wheel) for each in rolled]

    def cost(self, theta: Array, state: MotionState) -> float:
        """Half the robust sum of squares, priors included."""
        rows, _ = image_residuals(self.seen, self.data, self._at_exposure(theta, state), theta, self.scales.images)
        edges = sum(float(each.residual @ each.residual) for each in self._edges(theta, state))
        return robust_cost(rows) + 0.5 * (edges + float(self.prior @ theta**2) + self._held(state)[2])

    def system(self, theta: Array, state: MotionState, damping: float = 0.0) -> _System:
        """The normal equations at theta and `state`."""
        exposed = self._at_exposure(theta, state)
        fixed = self.rates_map, self.slopes
        images = image_rows(self.seen, self.data, (exposed, theta), self.scales.images, fixed)
        system = self._reduced(images, self._edges(theta, state), damping)
        diagonal, rhs, _ = self._held(state)
        system.information[np.diag_indices(self.size)] += np.concatenate([diagonal, self.prior])
        system.rhs[:] += np.concatenate([rhs, -self.prior * theta])
        return system

    def _held(self, state: MotionState) -> tuple[Array, Array, float]:
        """Diagonal and right-hand side of the weak priors that keep the gauge, and twice their cost."""
        diagonal = np.zeros((self.count, self.stride))
        diagonal[:, :6] = _LOOSE_SIGMAS**-2.0
        diagonal[0, :6] = (1e-3 * _FIRST_SIGMAS) ** -2.0 if not self.data.is_inertial else _FIRST_SIGMAS**-2.0
        off = np.zeros((self.count, self.stride))
        off[:, 3:6] = state.map_from_body[:, :3, 3] - self.data.start.map_from_body[:, :3, 3]
        if self.data.is_inertial:
            diagonal[0, 6:] = _BIAS_SIGMAS**-2.0
            off[0, 9:] = state.motions[0, 3:]
        return diagonal.ravel(), -(diagonal * off).ravel(), float((diagonal * off**2).sum())

    def _reduced(self, images: ImageRows, edges: list[Rows], damping: float) -> _System:
        info, rhs = np.zeros((self.size, self.size)), np.zeros(self.size)
        marks, columns, border = len(self.starts) - 1, UNKNOWNS, self.size - UNKNOWNS
        gone = BorderedLandmarks(np.empty((marks, 3, 3)), np.empty((marks, 3)), np.empty((marks, 3, columns)))
        if not core.reduce_landmarks(images, self.keyframes, self.starts, self.stride, damping, info, rhs, gone):
            raise np.linalg.LinAlgError("what a landmark's observations say of it is not finite")
        for each in edges:
            at = slice(each.first * self.stride, (each.first + 2) * self.stride)
            info[at, at] += each.by_keyframes.T @ each.by_keyframes
            info[at, border:] += each.by_keyframes.T @ each.by_calibration
            info[border:, border:] += each.by_calibration.T @ each.by_calibration
            rhs[at] -= each.by_keyframes.T @ each.residual
            rhs[border:] -= each.by_calibration.T @ each.residual
        return _System(info, rhs, images, edges, gone)

    def solve(self, system: _System, factor: tuple[Array, bool]) -> tuple[Array, Array]:
        """Step of the unknowns (D,) and of the landmarks (N, 3)."""
        step = scipy.linalg.cho_solve(factor, system.rhs, check_finite=False)
        moved = core.landmark_steps(system.images, self.keyframes, self.starts, system.eliminated, self.stride, step)
        return step, moved

    def _factor(self, system: _System, damping: float) -> tuple[Array, bool]:
        info = system.information.copy()
        info[np.diag_indices(self.size)] *= 1.0 + damping
        factor, lower = scipy.linalg.cho_factor(info, lower=False, overwrite_a=True, check_finite=False)
        return np.asarray(factor), bool(lower)

    def descend(self, theta: Array, state: MotionState, tolerance: float) -> tuple[Array, MotionState]:
        """The optimum near theta and `state`, by Levenberg-Marquardt."""
        cost, damping = self.cost(theta, state), 1e-6
        for _ in range(_MAX_STEPS):
            moved, gained = None, 0.0
            while moved is None and damping < 1e3:
                try:
                    system = self.system(theta, state, damping)
                    step, points = self.solve(system, self._factor(system, damping))
                    tried = theta + step[self.size - UNKNOWNS :], self._moved(state, step, points)
                    new = self.cost(*tried)
                except np.linalg.LinAlgError:
                    new = np.inf
                if new <= cost:
                    moved, gained, cost = tried, cost - new, new
                else:
                    damping *= 30.0
            if moved is None:
                break
            theta, state = moved
            damping = max(damping * 0.1, 1e-9)
            if gained < tolerance * cost:
                break
        return theta, state

    def _moved(self, state: MotionState, step: Array, points: Array) -> MotionState:
        steps = step[: self.size - UNKNOWNS].reshape(self.count, self.stride)
        placed = state.map_from_body.copy()
        for k in range(self.count):
            placed[k, :3, :3] = so3_exp(steps[k, :3]) @ placed[k, :3, :3]
        placed[:, :3, 3] += steps[:, 3:6]
        motions = state.motions + steps[:, 6:] if self.stride == 15 else state.motions
        return MotionState(placed, motions, state.points_map + points)

    def calibration_information(self, system: _System) -> Array:
        """(C, C) of the calibration with everything else marginalised."""
        border = self.size - UNKNOWNS
        info = system.information
        factor = scipy.linalg.cho_factor(info[:border, :border], lower=False, check_finite=False)
        coupled = scipy.linalg.cho_solve(factor, info[:border, border:], check_finite=False)
        reduced = info[border:, border:] - info[:border, border:].T @ coupled
        return np.asarray(0.5 * (reduced + reduced.T))

    def first_scales(self, theta: Array, state: MotionState) -> ErrorScales:
        """Wide enough for the median observation: under a wrong calibration nothing fits at first."""
        rows, _ = image_residuals(self.seen, self.data, state, theta, np.ones(4))
        norm = np.linalg.norm(rows[np.isfinite(self.seen.row_sigmas[:, 0])], axis=1)
        return ErrorScales(np.full(4, max(1.0, float(np.median(norm)) / _MEDIAN_NORM) if len(norm) else 1.0))

    def measured_scales(self, system: _System) -> ErrorScales:
        """The scales with which every kind of residual is as large as it should be."""
        found, expected = _squares(system.images.residuals, system.edges), self._expected(system)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sqrt(found / expected)
        ratio = np.where(np.isfinite(ratio) & (expected > 3.0), ratio, 1.0)
        s = self.scales
        limited = np.clip(ratio * [*s.images[1:], s.gyro, s.accel, s.wheel], _SMALLEST_SCALE, _LARGEST_SCALE)
        pixel, disparity, row, gyro, accel, wheel = limited.tolist()
        return ErrorScales(np.array([pixel, pixel, disparity, row]), gyro, accel, wheel)

    def scale_sigmas(self, system: _System) -> tuple[float, float]:
        """Sigmas of the gyro's and the accelerometer's scale, as shares of it: by their redundancy."""
        redundancy = self._expected(system)[3:5]
        gyro, accel = np.where(redundancy > 3.0, (2.0 * np.maximum(redundancy, 1e-9)) ** -0.5, np.inf).tolist()
        return gyro, accel

    def _expected(self, system: _System) -> Array:
        """(6,) sums of squares that each kind of residual would have if the sigmas were right: its redundancy.

        Random errors of the believed size are put in place of the residuals and the adjustment is solved for them.
        """
        rng, sums = np.random.default_rng(0), np.zeros((_DRAWS, 6))
        images, factor = system.images, self._factor(system, 0.0)
        active = np.abs(images.by_keyframe).sum(axis=2) > 0
        border = self.size - UNKNOWNS
        for draw in range(_DRAWS):
            drawn = np.where(active, rng.standard_normal(active.shape), 0.0)
            edges = [replace(each, residual=rng.standard_normal(len(each.residual))) for each in system.edges]
            random = self._reduced(images._replace(residuals=drawn), edges, 0.0)
            step, points = self.solve(random, factor)
            by_keyframe = step[:border].reshape(self.count, self.stride)
            left = drawn + np.einsum("meij,mj->mei", images.by_point[:, None], points[self.data.obs_landmark])[:, 0]
            left += np.einsum("mij,mj->mi", images.by_keyframe, by_keyframe[self.keyframes, :6])
            left += images.by_calibration @ step[border:]
            rest = []
            for each in edges:
                ends = by_keyframe[each.first : each.first + 2].ravel()
                residual = each.residual + each.by_keyframes @ ends + each.by_calibration @ step[border:]
                rest.append(replace(each, residual=residual))
            sums[draw] = _squares(np.where(active, left, 0.0), rest)
        return np.asarray(sums.mean(axis=0))


def _squares(images: Array, edges: list[Rows]) -> Array:
    """(6,) sums of squares: pixels, disparities, row differences, gyro, accelerometer, wheels along the way."""
    squares = (images**2).sum(axis=0)
    by_group = dict.fromkeys((ROTATION, MOTION, WHEEL), 0.0)
    for each in edges:
        for group in by_group:
            rows = each.residual[each.groups == group]
            by_group[group] += float(rows[0] ** 2 if group == WHEEL and len(rows) else rows @ rows)
    return np.array([squares[0] + squares[1], squares[2], squares[3], *by_group.values()])


def _divided(rows: Rows, scale: float) -> Rows:
    """The wheels' rows with another sigma along the way; slip sideways keeps its own."""
    factor = np.array([1.0 / scale, 1.0, 1.0])
    return replace(
        rows,
        residual=rows.residual * factor,
        by_keyframes=rows.by_keyframes * factor[:, None],
        by_calibration=rows.by_calibration * factor[:, None],
    )
