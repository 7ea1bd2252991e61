"""The right-invariant multi-state constraint filter: propagation, clones, update."""

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3, se3_inverse, skew, so3_log
from fleetmap.inertial import GRAVITY_MAP
from fleetmap.numerics.transform_kernels import earlier_from_later
from fleetmap.odometry.filter import covariance_kernels, msckf_kernels, propagation_kernels, state_kernels
from fleetmap.odometry.filter.msckf_kernels import Clones, NormalEquations, PixelModel, Tracks
from fleetmap.odometry.filter.nav_state import NavState
from fleetmap.odometry.filter.state_kernels import Window
from fleetmap.odometry.settings import FilterSettings
from fleetmap.odometry.tracking.tracks import TrackBatch
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import ImuSamples, WheelSample

_NAV = 15  # rotation, velocity, position, gyro bias, accelerometer bias
_OFFSET = 15  # index of the time offset
_CLONES = 16  # index of the first clone
_PAIR = 2  # of the considered errors, which lie before all others: the pair's disparity offset and depth scale
_POSITION_GATE = 11.345  # 0.99 of chi-square with 3 degrees of freedom
CONSIDERED = (
    4  # errors that are never estimated: disparity offset, depth scale, scales of the wheels' speed and yaw rate
)


@dataclass(frozen=True, slots=True)
class LinearMeasurement:
    """residual (n,) = jacobian (n, m) @ error + noise (n, n), for the first m errors of the filter.

    The covariances: noise weighs the measurement; true_noise, where it differs, and by_considered (n, 4), derivatives by
    the considered errors, go into the true error's covariance.
    """

    jacobian: Array
    residual: Array
    noise: Array
    true_noise: Array | None = None
    by_considered: Array | None = None


class InvariantFilter:
    """Keeps the current state and a window of past body transforms (clones) with their joint covariance.

    Without an IMU the state moves by `predict_random_walk` instead of `propagate`; velocity and biases are then idle.

    Two covariances are kept. `covariance` weighs and gates measurements: its noise is white, the same for all pixels, and
    wide, so that errors without a model do no harm. `true_error_cov` is the covariance of the true error after the same
    corrections, from a full error model: points that slip along their way, disparities that stay wrong, a pair that is
    slightly off. Only this one is reported. Source: covariance analysis of suboptimal filters, Maybeck 1979, chapter 6.
    """

    def __init__(
        self,
        state: NavState,
        nav_covariance: Array,
        settings: FilterSettings,
        camera: StereoCamera,
        body_from_cam: Array,
        true_error_cov: Array | None = None,
    ) -> None:
        """nav_covariance (15, 15) in the filter's error; true_error_cov: that of the true error, where it differs."""
        self.state = state.copy()
        self.imu_minus_cam_s = 0.0
        self.clone_ids: list[int] = []
        self._rotations, self._positions = np.zeros((0, 3, 3)), np.zeros((0, 3))
        self._settings = settings
        self._camera = camera.lens
        self._weights = np.array([1 / settings.pixel_sigma_px, 1 / settings.disparity_sigma_px])
        self._body_from_cam = np.ascontiguousarray(body_from_cam)
        self._noise = np.array(
            [
                settings.noise_share**2,
                settings.slip_along_share,
                settings.slip_across_share,
                settings.track_disparity_sigma_px,
            ]
        )
        self._pair_variance = np.array([settings.disparity_offset_sigma_px, settings.depth_scale_sigma]) ** 2
        self._quantile = NormalDist().inv_cdf(settings.chi_square_share)
        self.covariance = np.zeros((_CLONES, _CLONES))
        self.covariance[:_NAV, :_NAV] = nav_covariance
        self.covariance[_OFFSET, _OFFSET] = settings.time_offset_sigma_s**2
        self.true_error_cov = np.zeros((CONSIDERED + _CLONES, CONSIDERED + _CLONES))
        self.true_error_cov[CONSIDERED:, CONSIDERED:] = self.covariance
        if true_error_cov is not None:
            self.true_error_cov[CONSIDERED : CONSIDERED + _NAV, CONSIDERED : CONSIDERED + _NAV] = true_error_cov
        considered = np.array([settings.wheel_speed_scale_sigma, settings.wheel_yaw_scale_sigma]) ** 2
        self.true_error_cov[range(CONSIDERED), range(CONSIDERED)] = np.append(self._pair_variance, considered)

    def propagate(
        self, imu: ImuSamples, start_ns: int, end_ns: int, noise: ImuNoise, true_noise: ImuNoise | None = None
    ) -> Array:
        """Moves the state from start_ns to end_ns; returns the last angular rate (3,), bias removed.

        noise weighs the prediction; true_noise, where it differs, goes into true_error_cov.
        """
        kept, added = self._pair_kept(max(end_ns - start_ns, 0) * 1e-9)
        samples = imu.stamps_ns, imu.gyro_radps, imu.accel_mps2, int(start_ns), int(end_ns)
        errors = self.covariance, self.true_error_cov, CONSIDERED
        judged = _densities(noise, true_noise or noise)
        return propagation_kernels.predict(self.state.arrays, GRAVITY_MAP, *samples, judged, *errors, kept, added)

    def predict_random_walk(
        self,
        body_from_next: Array,
        rotation_sigma_rad: float,
        translation_sigma_m: float,
        duration_s: float = 0.0,
        measured_cov: Array | None = None,
    ) -> None:
        """Moves the state by a relative transform that is known only to the sigmas.

        measured_cov (6, 6), in the next body's axes, rotation first, is added information where it is given.
        """
        s = self.state
        rotation = s.rotation.copy()
        s.position_m = s.position_m + rotation @ body_from_next[:3, 3]
        s.rotation = rotation @ body_from_next[:3, :3]
        shape = np.zeros((_NAV, 6))
        shape[0:3, 0:3] = s.rotation
        shape[6:9, 0:3] = skew(s.position_m) @ s.rotation
        shape[6:9, 3:6] = s.rotation
        sigmas = np.array([rotation_sigma_rad] * 3 + [translation_sigma_m] * 3)
        free = np.diag(sigmas**2)
        # (free^-1 + measured^-1)^-1: the measured one where it is narrow, the free one where that is wider
        spread = free if measured_cov is None else free - free @ np.linalg.solve(free + measured_cov, free)
        process = np.asarray(shape @ spread @ shape.T)
        for covariance, first in ((self.covariance, 0), (self.true_error_cov, CONSIDERED)):
            covariance_kernels.transition(covariance, first, np.eye(_NAV), process)
        covariance_kernels.forget(self.true_error_cov, *self._pair_kept(duration_s))

    def add_clone(self, clone_id: int, rate_body_radps: Array) -> None:
        """Keeps the current body transform in the window; the rate ties it to the time offset."""
        self.clone_ids.append(clone_id)
        grown = state_kernels.add_clone(self._window, self.state.arrays, rate_body_radps, CONSIDERED, _OFFSET)
        self._rotations, self._positions, self.covariance, self.true_error_cov = grown

    def remove_clone(self, clone_id: int) -> None:
        """Forgets a clone (marginalises it)."""
        index = self.clone_ids.index(clone_id)
        del self.clone_ids[index]
        left = state_kernels.drop_clone(self._window, index, CONSIDERED, _CLONES)
        self._rotations, self._positions, self.covariance, self.true_error_cov = left

    def return_to_clone(self, clone_id: int) -> None:
        """Takes rotation and position of the state back to a clone's, as certain as that is; what moved them since is forgotten."""
        index = self.clone_ids.index(clone_id)
        self.state.rotation, self.state.position_m = self._rotations[index].copy(), self._positions[index].copy()
        self.covariance = _copied(self.covariance, _CLONES + 6 * index, 0)
        self.true_error_cov = _copied(self.true_error_cov, CONSIDERED + _CLONES + 6 * index, CONSIDERED)

    def begin_frame_anew(self) -> Array:
        """new_odom_from_old_odom (4, 4): the frame now begins at the newest clone, and errors count from there.

        Motions between clones, and what is known of them, stay as they are. Of the frame before only that is forgotten which none of
        them shows: how far it may be off altogether. With the distance from its origin that grows without bound, until the motion
        between two clones is a difference of numbers so large that rounding leaves no covariance. Velocity and biases must be idle.
        """
        begin_m = self._positions[-1].copy()
        self._move_origin(begin_m)
        for name, first in (("covariance", 0), ("true_error_cov", CONSIDERED)):
            covariance = getattr(self, name)
            bodies = [(first, first + 6)]
            bodies += [(first + at, first + at + 3) for at in range(_CLONES, len(covariance) - first, 6)]
            since = np.eye(len(covariance))
            newest = bodies[-1]
            for body in bodies:
                for one, other in zip(body, newest, strict=True):
                    since[range(one, one + 3), range(other, other + 3)] -= 1.0
            setattr(self, name, _symmetric(since @ covariance @ since.T))
        return se3(np.eye(3), -begin_m)

    def _move_origin(self, by_m: Array) -> None:
        """Counts positions, and errors of them, from another point (3,) of the frame."""
        self.state.position_m = self.state.position_m - by_m
        self._positions = self._positions - by_m
        for covariance, first in ((self.covariance, 0), (self.true_error_cov, CONSIDERED)):
            turns = np.append(first, np.arange(first + _CLONES, len(covariance), 6))[:, None] + np.arange(3)
            places = turns + np.append(6, np.full(len(turns) - 1, 3))[:, None]
            # p - by changes by Exp(turn) by - by besides
            covariance[places] -= skew(by_m) @ covariance[turns]
            covariance[:, places] -= covariance[:, turns] @ skew(by_m).T

    def odom_from_clone(self, clone_id: int) -> Array:
        """(4, 4) odom_from_body of a clone."""
        index = self.clone_ids.index(clone_id)
        return se3(self._rotations[index], self._positions[index])

    def update(
        self,
        tracks: TrackBatch,
        iterations: int = 1,
        newest_odom_from_body: Array | None = None,
        sigma_scale: float = 1.0,
    ) -> NDArray[np.int8]:
        """Uses each track once; (T,) 1 taken, 0 not triangulated, -1 rejected by its gate.

        More than one iteration relinearises (iterated Kalman filter), for large corrections; newest_odom_from_body is
        then where the newest clone is linearised first, when vision knows it better than the prediction. It adds no
        information. sigma_scale widens the measurement noise, for matches that are less exact than flow.
        """
        used = np.zeros(len(tracks), np.int8)
        if not len(tracks):
            return used
        held = np.array(self.clone_ids)
        clones, anchors = (state_kernels.rows_of(held, wanted) for wanted in (tracks.clone_ids, tracks.anchors))
        rows = Tracks(tracks.starts, clones, tracks.pixels, anchors, tracks.points_cam)
        model = PixelModel(self._camera, self._weights / sigma_scale, self._noise, self._quantile)
        # Errors count from here: those of a turn about an origin far away would be so large that rounding leaves no covariance.
        begin_m = self._positions[-1].copy()
        self._move_origin(begin_m)
        prior = self._kept()
        size = 6 * len(self.clone_ids)
        inner = np.ascontiguousarray(self.covariance[_CLONES:, _CLONES:])
        moved = np.zeros(size)
        if newest_odom_from_body is not None:
            newest_odom_from_body = se3(np.eye(3), -begin_m) @ newest_odom_from_body
            error = newest_odom_from_body @ se3_inverse(se3(self._rotations[-1], self._positions[-1]))
            moved[-6:] = np.concatenate([so3_log(error[:3, :3]), error[:3, 3]])
            self._rotations[-1] = newest_odom_from_body[:3, :3]
            self._positions[-1] = newest_odom_from_body[:3, 3]
        for _ in range(iterations):
            equations = NormalEquations(np.zeros((size, size + 2)), np.zeros((size, size)), np.zeros(size))
            bodies = Clones(self._rotations, self._positions, self._body_from_cam)
            msckf_kernels.accumulate_tracks(bodies, rows, model, inner, moved, equations, used)
            weighing = np.eye(size) + inner @ equations.information[:, _PAIR:].T
            gain = np.asarray(np.linalg.solve(weighing, self.covariance[_CLONES:]).T, np.float64)
            gain = _without_common_motion(gain, equations.information[:, _PAIR:])
            correction = gain @ equations.vector
            self._restore(prior)
            self._correct(correction)
            moved = correction[_CLONES:]
        self._learn(gain, equations.information, equations.scatter)
        self._move_origin(-begin_m)
        return used

    def _learn(self, gain: Array, information: Array, scatter: Array) -> None:
        """Both covariances after a correction by gain (n, 6 M), arguments as from `accumulate_tracks`."""
        by_pair, by_clones = information[:, :_PAIR], information[:, _PAIR:]
        self.covariance = _symmetric(self.covariance - gain @ (by_clones @ self.covariance[_CLONES:]))
        # (1 - gain @ information) @ true_error_cov @ (the same).T + gain @ scatter @ gain.T, at the price of its smaller side
        clones = CONSIDERED + _CLONES
        seen = by_pair @ self.true_error_cov[:_PAIR] + by_clones @ self.true_error_cov[clones:]
        spread = seen[:, :_PAIR] @ by_pair.T + seen[:, clones:] @ by_clones.T + scatter
        seen[:, CONSIDERED:] -= 0.5 * (spread @ gain.T)
        taken = gain @ seen
        own = taken[:, CONSIDERED:]
        self.true_error_cov[CONSIDERED:, CONSIDERED:] -= own + own.T
        self.true_error_cov[CONSIDERED:, :CONSIDERED] -= taken[:, :CONSIDERED]
        self.true_error_cov[:CONSIDERED, CONSIDERED:] = self.true_error_cov[CONSIDERED:, :CONSIDERED].T

    def correct_with(self, measurement: LinearMeasurement, *, gate: float = np.inf) -> float:
        """Corrects by a linear measurement; returns its squared Mahalanobis distance by true_error_cov.

        Nothing is changed where that exceeds the gate.
        """
        jacobian, residual, noise = measurement.jacobian, measurement.residual, measurement.noise
        true_noise = noise if measurement.true_noise is None else measurement.true_noise
        whole = np.zeros((len(residual), CONSIDERED + jacobian.shape[1]))
        whole[:, CONSIDERED:] = jacobian
        if measurement.by_considered is not None:
            whole[:, :CONSIDERED] = measurement.by_considered
        correction = np.empty(len(self.covariance))
        both, noises = (self.covariance, self.true_error_cov), (noise, true_noise)
        distance = covariance_kernels.correct(*both, whole, CONSIDERED, residual, *noises, float(gate), correction)
        if distance <= gate:
            self._correct(correction)
        return distance

    def inflate(self, clone_id: int, seen_odom_from_body: Array, gap_s: float) -> bool:
        """Inflates position and velocity where vision contradicts the prediction since `clone_id` beyond its covariance.

        After seconds without images an IMU's error can exceed its noise figures; a filter that then rejects every
        image never recovers. True where it inflated. To be called before the clone of this moment is added.
        """
        at = _CLONES + 6 * self.clone_ids.index(clone_id)
        pick = np.zeros((3, len(self.covariance)))
        pick[:, 6:9], pick[:, at + 3 : at + 6] = np.eye(3), -np.eye(3)
        pick[:, 0:3] = -skew(self.state.position_m)
        pick[:, at : at + 3] = skew(self.state.position_m)
        off = seen_odom_from_body[:3, 3] - self.state.position_m
        spread = pick @ self.covariance @ pick.T + 1e-4 * np.eye(3)
        if off @ np.linalg.solve(spread, off) < _POSITION_GATE:
            return False
        size = float(np.linalg.norm(off))
        for wide in (self.covariance, self.true_error_cov[CONSIDERED:, CONSIDERED:]):
            wide[6:9, 6:9] += size**2 * np.eye(3)
            wide[3:6, 3:6] += (size / max(gap_s, 0.1)) ** 2 * np.eye(3)
        return True

    def inflate_velocity(self, sigma_mps: float) -> None:
        """Adds the variance of an unknown change of velocity."""
        for wide in (self.covariance, self.true_error_cov[CONSIDERED:, CONSIDERED:]):
            wide[3:6, 3:6] += sigma_mps**2 * np.eye(3)

    def body_since(self, clone_id: int) -> Array:
        """earlier_from_now (4, 4) between a clone and the newest one."""
        return self.motion_between(clone_id, self.clone_ids[-1])

    def motion_between(self, earlier_id: int, later_id: int) -> Array:
        """earlier_from_later (4, 4) between two clones."""
        held = self.clone_ids.index(earlier_id), self.clone_ids.index(later_id)
        return earlier_from_later(self._rotations, self._positions, *held)

    def cam_from_earlier(self, clone_id: int, cam_from_body: Array) -> Array:
        """(4, 4) from a clone's camera to that of the state."""
        index, mounting = self.clone_ids.index(clone_id), (cam_from_body, self._body_from_cam)
        clone = self._rotations[index], self._positions[index]
        return state_kernels.cam_from_earlier(self.state.arrays, *clone, *mounting)

    def motion_since(self, clone_id: int) -> tuple[Array, Array]:
        """earlier_from_now (4, 4) between a clone and the newest one, and its covariance (6, 6).

        The covariance is that of a left perturbation in axes of the earlier body, from the joint covariance of both, so
        that what they share cancels.
        """
        index = self.clone_ids.index(clone_id)
        return state_kernels.motion_since(self._window, index, CONSIDERED + _CLONES)

    @property
    def offset_sigma_s(self) -> float:
        """Standard deviation of the time offset's true error."""
        return float(np.sqrt(self.true_error_cov[CONSIDERED + _OFFSET, CONSIDERED + _OFFSET]))

    def body_covariance(self) -> Array:
        """cov_rot_trans (6, 6) of odom_from_body: rotation error in odom axes, then position error."""
        return state_kernels.body_covariance(self.state.position_m, self.true_error_cov, CONSIDERED)

    @property
    def _window(self) -> Window:
        return Window(self._rotations, self._positions, self.covariance, self.true_error_cov)

    def _pair_kept(self, duration_s: float) -> tuple[float, Array]:
        """What is kept of the pair's errors, which change with the view, and the variances (2,) that come in for the rest.

        A first-order Gauss-Markov process, back to the prior.
        """
        kept = math.exp(-duration_s / self._settings.pair_error_memory_s)
        return kept, (1 - kept**2) * self._pair_variance

    def _kept(self) -> tuple[NavState, Array, Array, float]:
        return self.state.copy(), self._rotations.copy(), self._positions.copy(), self.imu_minus_cam_s

    def _restore(self, kept: tuple[NavState, Array, Array, float]) -> None:
        self.state = kept[0].copy()
        self._rotations, self._positions, self.imu_minus_cam_s = kept[1].copy(), kept[2].copy(), kept[3]

    def _correct(self, error: Array) -> None:
        self.imu_minus_cam_s += float(error[_OFFSET])
        state_kernels.apply_error(self.state.arrays, self._rotations, self._positions, error)


def zero_velocity(
    state: NavState, gyro_mean_radps: Array, gyro_sigma_radps: float, settings: FilterSettings
) -> LinearMeasurement:
    """The body neither moves nor turns: velocity zero, the gyro shows its bias alone (ZUPT).

    gyro_mean_radps (3,) over the time since the last frame, known to gyro_sigma_radps.
    """
    jacobian = np.zeros((6, _NAV))
    jacobian[:3, :3], jacobian[:3, 3:6] = -skew(state.velocity_mps), np.eye(3)
    jacobian[3:, 9:12] = np.eye(3)
    residual = np.concatenate([-state.velocity_mps, gyro_mean_radps - state.gyro_bias_radps])
    sigmas = np.array([settings.still_sigma_mps] * 3 + [gyro_sigma_radps] * 3)
    return LinearMeasurement(jacobian, residual, np.diag(sigmas**2))


def wheel_odometry(
    state: NavState, sample: WheelSample, gyro_radps: Array, base_from_body: Array, settings: FilterSettings
) -> LinearMeasurement:
    """The motion of `base` by its wheels: forward speed, no other, and yaw rate. gyro_radps (3,): measured at the same time."""
    jacobian, by_considered = np.zeros((4, _NAV)), np.zeros((4, CONSIDERED))
    measured = sample.velocity_base_mps, float(sample.yaw_rate_radps), gyro_radps, base_from_body
    residual = state_kernels.wheel_rows(state.arrays, *measured, jacobian, by_considered)
    sigmas = np.array([sample.sigma_mps, settings.wheel_slip_mps, settings.wheel_slip_mps, sample.sigma_radps])
    weighed = np.diag((settings.wheel_sigma_scale * sigmas) ** 2)
    return LinearMeasurement(jacobian, residual, weighed, np.diag(sigmas**2), by_considered)


@lru_cache
def _densities(*noises: ImuNoise) -> Array:
    walks = [(noise.gyro_walk_radps2_rthz, noise.accel_walk_mps3_rthz) for noise in noises]
    whites = [(noise.gyro_noise_radps_rthz, noise.accel_noise_mps2_rthz) for noise in noises]
    return np.hstack([whites, walks])


def _copied(covariance: Array, at: int, nav: int) -> Array:
    """The covariance where the errors of rotation and position of the state that begins at nav become those of the clone at `at`."""
    order = np.arange(len(covariance))
    order[nav : nav + 3], order[nav + 6 : nav + 9] = order[at : at + 3], order[at + 3 : at + 6]
    return covariance[np.ix_(order, order)]


def _without_common_motion(gain: Array, information: Array) -> Array:
    """A gain (n, 6 M) without its part on errors that clones which see the same points share: in exact numbers it changes nothing.

    information (6 M, 6 M). After gaps the variance of what such clones share, which no image shows, is 10^8 times that of the motion
    between them. Rounding of the measurements, times such a gain, would leave negative variances.
    """
    count = len(information) // 6
    linked = (information.reshape(count, 6, count, 6) != 0.0).any(axis=(1, 3)) | np.eye(count, dtype=bool)
    for _ in range(count.bit_length()):
        linked = linked @ linked
    by_clone = gain.reshape(len(gain), count, 6)
    shared = np.tensordot(by_clone, linked / linked.sum(axis=0), axes=(1, 0)).transpose(0, 2, 1)
    return np.asarray((by_clone - shared).reshape(gain.shape))


def _symmetric(covariance: Array) -> Array:
    return np.asarray(0.5 * (covariance + covariance.T))
