"""The right-invariant multi-state constraint filter: state, propagation, clones, update."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3, se3_inverse, skew, so3_exp, so3_log
from fleetmap.odometry.filter import msckf_kernels
from fleetmap.odometry.settings import FilterSettings
from fleetmap.odometry.tracking.tracks import Track, TrackBatch
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import ImuSamples, WheelSample

GRAVITY_MPS2 = 9.81
_GRAVITY = np.array([0.0, 0.0, -GRAVITY_MPS2])
_NAV = 15  # rotation, velocity, position, gyro bias, accelerometer bias
_OFFSET = 15  # index of the time offset
_CLONES = 16  # index of the first clone
# Before all others the budget has what is allowed for and never estimated: the pair's disparity offset and depth scale,
# scales of the wheels' speed and yaw rate.
_PAIR, _ALLOWED = 2, 4
_POSITION_GATE = 11.345  # 0.99 of chi-square with 3 degrees of freedom


@dataclass
class NavState:
    """Nominal state in `odom`."""

    rotation: Array = field(default_factory=lambda: np.eye(3))
    velocity_mps: Array = field(default_factory=lambda: np.zeros(3))
    position_m: Array = field(default_factory=lambda: np.zeros(3))
    gyro_bias_radps: Array = field(default_factory=lambda: np.zeros(3))
    accel_bias_mps2: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def odom_from_body(self) -> Array:
        """(4, 4)."""
        return se3(self.rotation, self.position_m)


class InvariantFilter:
    """Keeps the current state and a window of past body transforms (clones) with their joint covariance.

    Without an IMU the state moves by `predict_random_walk` instead of `propagate`; velocity and biases are then idle.

    Two covariances are kept. `covariance` is what measurements are weighed and gated by: noise that is white, the same
    for all pixels, and wide, which is robust to what no model tells. `budget` is what the same corrections leave of all
    errors that are known: points that slip along their way, disparities that stay wrong, a pair that is slightly off.
    It alone is reported. Source: covariance analysis of suboptimal filters, Maybeck 1979, chapter 6.
    """

    def __init__(
        self,
        state: NavState,
        nav_covariance: Array,
        settings: FilterSettings,
        camera: StereoCamera,
        body_from_cam: Array,
        budget: Array | None = None,
    ) -> None:
        """nav_covariance (15, 15) in the filter's error; budget: the same as it really is, where it differs."""
        self.state = state
        self.imu_minus_cam_s = 0.0
        self.clone_ids: list[int] = []
        self._rotations, self._positions = np.zeros((0, 3, 3)), np.zeros((0, 3))
        self._settings = settings
        self._camera = np.array([camera.focal_px, camera.cx_px, camera.cy_px, camera.focal_px * camera.baseline_m])
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
        self.budget = np.zeros((_ALLOWED + _CLONES, _ALLOWED + _CLONES))
        self.budget[_ALLOWED:, _ALLOWED:] = self.covariance
        if budget is not None:
            self.budget[_ALLOWED : _ALLOWED + _NAV, _ALLOWED : _ALLOWED + _NAV] = budget
        allowed = [settings.disparity_offset_sigma_px, settings.depth_scale_sigma]
        allowed += [settings.wheel_speed_scale_sigma, settings.wheel_yaw_scale_sigma]
        self.budget[range(_ALLOWED), range(_ALLOWED)] = np.array(allowed) ** 2

    def propagate(
        self, imu: ImuSamples, start_ns: int, end_ns: int, noise: ImuNoise, real_noise: ImuNoise | None = None
    ) -> Array:
        """Moves the state from start_ns to end_ns; returns the last angular rate (3,), bias removed.

        noise weighs the prediction; real_noise, where it differs, goes into the budget.
        """
        steps_s, gyro, accel = imu_intervals(imu, start_ns, end_ns)
        phi, processes = np.eye(_NAV), np.zeros((2, _NAV, _NAV))
        if len(steps_s):
            s = self.state
            msckf_kernels.propagate(
                s.rotation, s.velocity_mps, s.position_m, s.gyro_bias_radps, s.accel_bias_mps2, _GRAVITY,
                steps_s, gyro, accel, np.array([_densities(noise), _densities(real_noise or noise)]), phi, processes,
            )  # fmt: skip
        self._transition(phi, *processes)
        self._forget_pair(max(end_ns - start_ns, 0) * 1e-9)
        return gyro[-1] - self.state.gyro_bias_radps if len(gyro) else np.zeros(3)

    def predict_random_walk(
        self, body_from_next: Array, rotation_sigma_rad: float, translation_sigma_m: float, duration_s: float = 0.0,
        known: Array | None = None,
    ) -> None:  # fmt: skip
        """Moves the state by a relative transform that is known only as well as the sigmas say.

        known (6, 6), where it is given, says it better: a covariance in the next body's axes, rotation first.
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
        # both together: known where it is narrow, free where it is wider than that
        spread = free if known is None else free - free @ np.linalg.solve(free + known, free)
        process = np.asarray(shape @ spread @ shape.T)
        self._transition(np.eye(_NAV), process, process)
        self._forget_pair(duration_s)

    def add_clone(self, clone_id: int, rate_body_radps: Array) -> None:
        """Keeps the current body transform in the window; the rate ties it to the time offset."""
        s, size = self.state, len(self.covariance)
        turn = s.rotation @ rate_body_radps
        jacobian = np.zeros((6, size))
        jacobian[0:3, 0:3] = np.eye(3)
        jacobian[3:6, 6:9] = np.eye(3)
        jacobian[0:3, _OFFSET] = turn
        jacobian[3:6, _OFFSET] = s.velocity_mps + skew(s.position_m) @ turn
        self.covariance = _grown(self.covariance, jacobian)
        self.budget = _grown(self.budget, np.hstack([np.zeros((6, _ALLOWED)), jacobian]))
        self.clone_ids.append(clone_id)
        self._rotations = np.concatenate([self._rotations, s.rotation[None]])
        self._positions = np.concatenate([self._positions, s.position_m[None]])

    def remove_clone(self, clone_id: int) -> None:
        """Forgets a clone (marginalises it)."""
        index = self.clone_ids.index(clone_id)
        at = _CLONES + 6 * index
        self.covariance, self.budget = _without(self.covariance, at), _without(self.budget, _ALLOWED + at)
        del self.clone_ids[index]
        self._rotations = np.delete(self._rotations, index, axis=0)
        self._positions = np.delete(self._positions, index, axis=0)

    def odom_from_clone(self, clone_id: int) -> Array:
        """(4, 4) odom_from_body of a clone."""
        index = self.clone_ids.index(clone_id)
        return se3(self._rotations[index], self._positions[index])

    def update(
        self,
        tracks: TrackBatch | Sequence[Track],
        iterations: int = 1,
        newest_odom_from_body: Array | None = None,
        sigma_scale: float = 1.0,
    ) -> NDArray[np.int8]:
        """Uses each track once; (T,) 1 taken, 0 not triangulated, -1 refused by its gate.

        More than one iteration relinearises (iterated Kalman filter), for large corrections; newest_odom_from_body is
        then where the newest clone is linearised first, when vision knows it better than the prediction. It adds no
        information. sigma_scale widens the measurement noise, for matches that are less exact than flow.
        """
        batch = tracks if isinstance(tracks, TrackBatch) else TrackBatch.of(tracks)
        used = np.zeros(len(batch), np.int8)
        if not len(batch):
            return used
        order = np.argsort(self.clone_ids)
        ids = np.array(self.clone_ids)[order]
        clones, anchors = (order[np.searchsorted(ids, wanted)] for wanted in (batch.clone_ids, batch.anchors))
        prior = self._kept()
        size = 6 * len(self.clone_ids)
        inner = np.ascontiguousarray(self.covariance[_CLONES:, _CLONES:])
        moved = np.zeros(size)
        if newest_odom_from_body is not None:
            error = newest_odom_from_body @ se3_inverse(se3(self._rotations[-1], self._positions[-1]))
            moved[-6:] = np.concatenate([so3_log(error[:3, :3]), error[:3, 3]])
            self._rotations[-1] = newest_odom_from_body[:3, :3]
            self._positions[-1] = newest_odom_from_body[:3, 3]
        for _ in range(iterations):
            information, scatter, vector = np.zeros((size, size + 2)), np.zeros((size, size)), np.zeros(size)
            msckf_kernels.accumulate_tracks(
                self._rotations, self._positions, self._body_from_cam, batch.starts, clones, batch.pixels, anchors,
                batch.points_cam, self._camera, self._weights / sigma_scale, self._noise, inner, moved, self._quantile,
                information, scatter, vector, used,
            )  # fmt: skip
            weighing = np.eye(size) + inner @ information[:, _PAIR:].T
            gain = np.asarray(np.linalg.solve(weighing, self.covariance[_CLONES:]).T, np.float64)
            correction = gain @ vector
            self._restore(prior)
            self._correct(correction)
            moved = correction[_CLONES:]
        self._learn(gain, information, scatter)
        return used

    def _learn(self, gain: Array, information: Array, scatter: Array) -> None:
        """Both covariances after a correction by gain (n, 6 M), arguments as from `accumulate_tracks`."""
        learned = gain @ (information[:, _PAIR:] @ self.covariance[_CLONES:])
        self.covariance = _symmetric(self.covariance - learned)
        left = np.eye(len(self.budget))
        left[_ALLOWED:, :_PAIR] -= gain @ information[:, :_PAIR]
        left[_ALLOWED:, _ALLOWED + _CLONES :] -= gain @ information[:, _PAIR:]
        self._carry_budget(left, gain, scatter)

    def _carry_budget(self, left: Array, gain: Array, noise: Array) -> None:
        self.budget = left @ self.budget @ left.T
        self.budget[_ALLOWED:, _ALLOWED:] += gain @ noise @ gain.T
        self.budget = _symmetric(self.budget)

    def correct_with(
        self, jacobian: Array, residual: Array, noise: Array, *, gate: float = np.inf, real_noise: Array | None = None,
        by_allowed: Array | None = None,
    ) -> float:  # fmt: skip
        """A linear measurement residual = jacobian @ error + noise; returns its normalised innovation squared.

        noise weighs it; real_noise, where it differs, and by_allowed (n, 4), derivatives by the errors that are allowed
        for, go into the budget. Nothing is changed where the innovation, by the budget, exceeds the gate.
        """
        allowed = np.zeros((len(residual), _ALLOWED)) if by_allowed is None else by_allowed
        whole = np.zeros((len(residual), len(self.budget)))
        whole[:, :_ALLOWED], whole[:, _ALLOWED : _ALLOWED + jacobian.shape[1]] = allowed, jacobian
        real = noise if real_noise is None else real_noise
        normalised = float(residual @ np.linalg.solve(whole @ self.budget @ whole.T + real, residual))
        if normalised > gate:
            return normalised
        full = whole[:, _ALLOWED:]
        cross = self.covariance @ full.T
        innovation = full @ cross + noise
        gain = np.asarray(np.linalg.solve(innovation, cross.T).T, np.float64)
        self._correct(gain @ residual)
        self.covariance = _symmetric(self.covariance - gain @ innovation @ gain.T)
        # as _carry_budget with left = 1 - gain @ whole, at the price of the few rows that `whole` has
        known = whole @ self.budget
        half = -0.5 * (known @ whole.T + real) @ gain.T
        half += known[:, _ALLOWED:]
        taken = np.zeros_like(self.budget)
        taken[_ALLOWED:, _ALLOWED:] = gain @ half
        taken[_ALLOWED:, :_ALLOWED] = gain @ known[:, :_ALLOWED]
        self.budget = _symmetric(self.budget - taken - taken.T)
        return normalised

    def zero_velocity_update(self, gyro_mean_radps: Array, gyro_sigma_radps: float, gate: float) -> float:
        """The body neither moves nor turns: velocity zero, the gyro shows its bias alone.

        gyro_mean_radps (3,) over the time since the last frame, known to gyro_sigma_radps. Gated as `correct_with`.
        """
        jacobian, s = np.zeros((6, _CLONES)), self.state
        jacobian[:3, :3], jacobian[:3, 3:6] = -skew(s.velocity_mps), np.eye(3)
        jacobian[3:, 9:12] = np.eye(3)
        residual = np.concatenate([-s.velocity_mps, gyro_mean_radps - s.gyro_bias_radps])
        sigmas = np.array([self._settings.still_sigma_mps] * 3 + [gyro_sigma_radps] * 3)
        return self.correct_with(jacobian, residual, np.diag(sigmas**2), gate=gate)

    def roll(self, sample: WheelSample, gyro_radps: Array, base_from_body: Array, gate: float) -> float:
        """What the wheels say of the motion of `base`: forward speed, no other, and yaw rate. Gated as `correct_with`.

        gyro_radps (3,): as measured at the same time.
        """
        s, settings = self.state, self._settings
        turn, base_body = base_from_body[:3, :3], se3_inverse(base_from_body)[:3, 3]
        rate = gyro_radps - s.gyro_bias_radps
        back = turn @ s.rotation.T
        velocity = back @ s.velocity_mps + turn @ (skew(rate) @ base_body)
        jacobian = np.zeros((4, _CLONES))
        # R^T v with the invariant error changes by R^T nu alone: turning the frame turns both
        jacobian[:3, 3:6] = back
        jacobian[:3, 9:12] = turn @ skew(base_body)
        jacobian[3, 9:12] = -turn[2]
        residual = np.append(sample.velocity_base_mps - velocity, sample.yaw_rate_radps - (turn @ rate)[2])
        sigmas = np.array([sample.sigma_mps, settings.wheel_slip_mps, settings.wheel_slip_mps, sample.sigma_radps])
        allowed = np.zeros((4, _ALLOWED))
        allowed[0, 2], allowed[3, 3] = velocity[0], (turn @ rate)[2]
        weighed = np.diag((settings.wheel_sigma_scale * sigmas) ** 2)
        return self.correct_with(
            jacobian, residual, weighed, gate=gate, real_noise=np.diag(sigmas**2), by_allowed=allowed
        )

    def inflate(self, clone_id: int, seen_odom_from_body: Array, gap_s: float) -> bool:
        """Widens position and velocity where vision contradicts the prediction since `clone_id` beyond its covariance.

        After seconds without pictures an IMU's error can exceed what its noise figures admit; a filter that then
        refuses every picture never recovers. True where it widened. To be called before the clone of this moment is
        added.
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
        for wide in (self.covariance, self.budget[_ALLOWED:, _ALLOWED:]):
            wide[6:9, 6:9] += size**2 * np.eye(3)
            wide[3:6, 3:6] += (size / max(gap_s, 0.1)) ** 2 * np.eye(3)
        return True

    def inflate_velocity(self, sigma_mps: float) -> None:
        """The velocity may have changed by so much."""
        for wide in (self.covariance, self.budget[_ALLOWED:, _ALLOWED:]):
            wide[3:6, 3:6] += sigma_mps**2 * np.eye(3)

    def motion_since(self, clone_id: int) -> tuple[Array, Array]:
        """earlier_from_now (4, 4) between a clone and the newest one, and its covariance (6, 6).

        The covariance is that of a left perturbation in axes of the earlier body, from the joint covariance of both, so
        that what they share cancels.
        """
        at = _CLONES + 6 * self.clone_ids.index(clone_id)
        newest = _CLONES + 6 * (len(self.clone_ids) - 1)
        c = self.budget[_ALLOWED:, _ALLOWED:]
        difference = c[newest : newest + 6, newest : newest + 6] + c[at : at + 6, at : at + 6]
        difference = difference - c[newest : newest + 6, at : at + 6] - c[at : at + 6, newest : newest + 6]
        earlier_from_odom = se3_inverse(self.odom_from_clone(clone_id))
        rotation = earlier_from_odom[:3, :3]
        carry = np.zeros((6, 6))
        carry[:3, :3] = carry[3:, 3:] = rotation
        carry[3:, :3] = skew(earlier_from_odom[:3, 3]) @ rotation
        now = self.odom_from_clone(self.clone_ids[-1])
        return np.asarray(earlier_from_odom @ now), np.asarray(carry @ difference @ carry.T)

    def body_covariance(self) -> Array:
        """cov_rot_trans (6, 6) of odom_from_body: rotation error in odom axes, then position error."""
        jacobian = np.zeros((6, _NAV))
        jacobian[0:3, 0:3] = np.eye(3)
        jacobian[3:6, 0:3] = -skew(self.state.position_m)
        jacobian[3:6, 6:9] = np.eye(3)
        return np.asarray(jacobian @ self.budget[_ALLOWED : _ALLOWED + _NAV, _ALLOWED : _ALLOWED + _NAV] @ jacobian.T)

    def _transition(self, phi: Array, process: Array, real_process: Array) -> None:
        for covariance, at, noise in ((self.covariance, 0, process), (self.budget, _ALLOWED, real_process)):
            nav = slice(at, at + _NAV)
            covariance[nav, :] = phi @ covariance[nav, :]
            covariance[:, nav] = covariance[:, nav] @ phi.T
            covariance[nav, nav] += noise

    def _forget_pair(self, duration_s: float) -> None:
        """The pair's errors change with what is in view: they drift back to their prior (Gauss-Markov)."""
        kept = float(np.exp(-duration_s / self._settings.pair_error_memory_s))
        self.budget[:_PAIR, :] *= kept
        self.budget[:, :_PAIR] *= kept
        self.budget[range(_PAIR), range(_PAIR)] += (1 - kept**2) * self._pair_variance

    def _kept(self) -> tuple[NavState, Array, Array, float]:
        return NavState(**vars(self.state)), self._rotations.copy(), self._positions.copy(), self.imu_minus_cam_s

    def _restore(self, kept: tuple[NavState, Array, Array, float]) -> None:
        self.state = NavState(**vars(kept[0]))
        self._rotations, self._positions, self.imu_minus_cam_s = kept[1].copy(), kept[2].copy(), kept[3]

    def _correct(self, error: Array) -> None:
        s = self.state
        turn = so3_exp(error[0:3])
        s.rotation = turn @ s.rotation
        s.velocity_mps = turn @ s.velocity_mps + error[3:6]
        s.position_m = turn @ s.position_m + error[6:9]
        s.gyro_bias_radps = s.gyro_bias_radps + error[9:12]
        s.accel_bias_mps2 = s.accel_bias_mps2 + error[12:15]
        self.imu_minus_cam_s += float(error[_OFFSET])
        msckf_kernels.turn_clones(self._rotations, self._positions, error[_CLONES:])


def _densities(noise: ImuNoise) -> list[float]:
    return [
        noise.gyro_noise_radps_rthz, noise.accel_noise_mps2_rthz, noise.gyro_walk_radps2_rthz, noise.accel_walk_mps3_rthz
    ]  # fmt: skip


def _grown(covariance: Array, jacobian: Array) -> Array:
    """The covariance with six more errors, which are jacobian (6, n) times those that it has."""
    size = len(covariance)
    cross = jacobian @ covariance
    grown = np.empty((size + 6, size + 6))
    grown[:size, :size] = covariance
    grown[size:, :size] = cross
    grown[:size, size:] = cross.T
    grown[size:, size:] = cross @ jacobian.T
    return grown


def _without(covariance: Array, at: int) -> Array:
    """The covariance less the six errors that begin there."""
    size = len(covariance) - 6
    kept = np.empty((size, size))
    kept[:at, :at], kept[:at, at:] = covariance[:at, :at], covariance[:at, at + 6 :]
    kept[at:, :at], kept[at:, at:] = covariance[at + 6 :, :at], covariance[at + 6 :, at + 6 :]
    return kept


def _symmetric(covariance: Array) -> Array:
    return np.asarray(0.5 * (covariance + covariance.T))


def imu_intervals(imu: ImuSamples, start_ns: int, end_ns: int) -> tuple[Array, Array, Array]:
    """Intervals (N,) seconds between start and end with gyro and accel (N, 3) at their middles, linearly interpolated.

    Beyond the first and last sample the nearest one is held.
    """
    if end_ns <= start_ns or len(imu) == 0:
        return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))
    first, end = np.searchsorted(imu.stamps_ns, [start_ns + 1, end_ns]).tolist()
    edges = np.concatenate([[start_ns], imu.stamps_ns[first:end], [end_ns]]).astype(np.int64)
    origin = edges[0]
    middles = 0.5 * ((edges[1:] - origin) + (edges[:-1] - origin))
    around = slice(max(first - 1, 0), end + 1)
    at = (imu.stamps_ns[around] - origin).astype(np.float64)
    gyro = np.stack([np.interp(middles, at, imu.gyro_radps[around, k]) for k in range(3)], axis=1)
    accel = np.stack([np.interp(middles, at, imu.accel_mps2[around, k]) for k in range(3)], axis=1)
    return np.diff(edges) * 1e-9, gyro, accel
