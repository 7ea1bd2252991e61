"""Scale, speed and gravity of one camera with an IMU, by its fixes in a map: the map's metres and vertical in place of a second camera."""

from dataclasses import replace

import numpy as np

from fleetmap.core import longest_gap_ns
from fleetmap.geometry import Array, skew, so3_exp, so3_log
from fleetmap.inertial import preintegrate
from fleetmap.odometry.filter.msckf import InvariantFilter
from fleetmap.odometry.filter.nav_state import InitialState, NavState
from fleetmap.odometry.filter.sliding_window import OdometryRig
from fleetmap.odometry.modes import ImuInputs
from fleetmap.odometry.sensor_buffer import IMU_GAP_NS
from fleetmap.odometry.settings import FilterSettings

_ANY_SPEED_MPS = 10.0  # sigma, of a robot that has one fix
_MOVES_3, _GATE_6 = 16.266, 22.458  # 0.999 of chi-square with 3 and 6 degrees of freedom


def knows_speed(covariance: Array, settings: FilterSettings) -> bool:
    """Return True if the speed, by the covariance of a state, is as certain as those of other starts."""
    return bool(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1] <= settings.initial_velocity_sigma_mps**2)


def knows_direction(start: InitialState) -> bool:
    """Return True if a state is certainly in motion: before, its images cannot place points, whose distance its step measures."""
    velocity_mps = start.state.velocity_mps
    return bool(velocity_mps @ np.linalg.solve(start.covariance[3:6, 3:6], velocity_mps) > _MOVES_3)


class MapStart:
    """Inertial navigation by fixes alone. The first fix gives the pose, the second the speed, each further one is tested.

    Sources: Groves 2013, section 14.1 (loosely coupled integration); Barrau and Bonnabel 2017 (the error).
    """

    def __init__(self, rig: OdometryRig, imu: ImuInputs) -> None:
        self._rig, self._imu = rig, imu
        self._start: InitialState | None = None
        self._tested = 0  # fixes that agreed with those before

    def handle(self, stamp_ns: int, map_from_body: Array, cov_rot_trans: Array, *, needed: int) -> InitialState | None:
        """Return the state at a fix, map_from_body (4, 4), in axes of the map; None until `needed` fixes agree and show the speed.

        stamp_ns: on the IMU's clock, whose samples must be known until then. cov_rot_trans (6, 6) includes the error of the map.
        """
        samples, before = self._imu.samples.imu, self._start
        if before is None or longest_gap_ns(samples.stamps_ns, before.stamp_ns, stamp_ns) > IMU_GAP_NS:
            self._begin(stamp_ns, map_from_body, cov_rot_trans)
            return None
        if not self._tested:
            before = self._with_gyro_bias(before, stamp_ns, map_from_body)
        state, covariance = self._propagated(before, stamp_ns)
        # right-invariant errors: a rotation from the left turns the position about the origin of the map
        shown = np.zeros((6, 15))
        shown[:3, :3] = shown[3:, 6:9] = np.eye(3)
        shown[3:, :3] = -skew(state.position_m)
        off = np.concatenate(
            [so3_log(map_from_body[:3, :3] @ state.rotation.T), map_from_body[:3, 3] - state.position_m]
        )
        of_off = shown @ covariance @ shown.T + cov_rot_trans
        if off @ np.linalg.solve(of_off, off) > _GATE_6:
            self._begin(stamp_ns, map_from_body, cov_rot_trans)
            return None
        gain = np.linalg.solve(of_off, shown @ covariance).T
        error, rest = gain @ off, np.eye(15) - gain @ shown
        turn = so3_exp(error[:3])
        state = NavState(
            turn @ state.rotation,
            turn @ state.velocity_mps + error[3:6],
            turn @ state.position_m + error[6:9],
            state.gyro_bias_radps + error[9:12],
            state.accel_bias_mps2 + error[12:],
        )
        self._start = InitialState(state, rest @ covariance @ rest.T + gain @ cov_rot_trans @ gain.T, stamp_ns)
        self._tested += 1
        is_known = self._tested + 1 >= needed and knows_speed(self._start.covariance, self._rig.settings.filter)
        return self._start if is_known else None

    def _begin(self, stamp_ns: int, map_from_body: Array, cov_rot_trans: Array) -> None:
        """Begin at a fix, of any speed and with the biases that sensors may have."""
        settings, position_m = self._rig.settings, map_from_body[:3, 3]
        jacobian = np.zeros((15, 6))
        jacobian[:3, :3] = jacobian[6:9, 3:] = np.eye(3)
        jacobian[6:9, :3] = skew(position_m)
        gyro, accel = settings.start.steady_gyro_mean_radps, settings.filter.initial_accel_bias_sigma_mps2
        own = np.diag(np.square(np.repeat([0.0, _ANY_SPEED_MPS, 0.0, gyro, accel], 3)))
        state = NavState(rotation=map_from_body[:3, :3], position_m=position_m)
        self._start = InitialState(state, own + jacobian @ cov_rot_trans @ jacobian.T, stamp_ns)
        self._tested = 0

    def _with_gyro_bias(self, start: InitialState, stamp_ns: int, map_from_body: Array) -> InitialState:
        """Return the first state with the gyro's bias that explains the turn until the second fix, about which errors are small."""
        bias, seen = np.zeros(3), start.state.rotation.T @ map_from_body[:3, :3]
        for _ in range(3):
            term = preintegrate(
                self._imu.samples.imu, start.stamp_ns, stamp_ns, bias, np.zeros(3), self._imu.weighing_noise
            )
            bias = bias + np.linalg.lstsq(term.d_rotation_d_gyro, so3_log(term.delta_rotation.T @ seen), rcond=None)[0]
        return replace(start, state=replace(start.state, gyro_bias_radps=bias))

    def _propagated(self, start: InitialState, stamp_ns: int) -> tuple[NavState, Array]:
        settings, noise = self._rig.settings.filter, self._imu.weighing_noise
        moved = InvariantFilter(start.state, start.covariance, settings, self._rig.mounted)
        moved.propagate(self._imu.samples.imu, start.stamp_ns, stamp_ns, noise)
        return moved.state, moved.covariance[:15, :15]
