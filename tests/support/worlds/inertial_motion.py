"""A smooth motion whose place, velocity, rate and specific force are known in closed form, for tests."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.inertial import GRAVITY_MAP, Preintegrated
from fleetmap.sensors.samples import ImuSamples

GRAVITY = np.array([0.0, 0.0, -9.81])
AMPLITUDE_M, RATE_RADPS, PHASE = np.array([1.5, 1.0, 0.3]), np.array([0.9, 1.3, 1.7]), np.array([0.3, 1.1, 2.0])
ROLL, PITCH = (0.15, 1.1), (0.12, 0.8)


class Motion(NamedTuple):
    """State at one moment."""

    map_from_body: Array
    velocity_map_mps: Array
    gyro_radps: Array
    accel_mps2: Array


def analytic_motion(time_s: float) -> Motion:
    """Lissajous translation; yaw, pitch, roll as sums of sines, rotation Rz(yaw) Ry(pitch) Rx(roll)."""
    angle = RATE_RADPS * time_s + PHASE
    position = AMPLITUDE_M * np.sin(angle)
    velocity = AMPLITUDE_M * RATE_RADPS * np.cos(angle)
    acceleration = -AMPLITUDE_M * RATE_RADPS**2 * np.sin(angle)
    yaw, yaw_rate = 0.5 * time_s + 0.2 * np.sin(time_s), 0.5 + 0.2 * np.cos(time_s)
    pitch, pitch_rate = PITCH[0] * np.sin(PITCH[1] * time_s), PITCH[0] * PITCH[1] * np.cos(PITCH[1] * time_s)
    roll, roll_rate = ROLL[0] * np.sin(ROLL[1] * time_s), ROLL[0] * ROLL[1] * np.cos(ROLL[1] * time_s)
    turn_roll, turn_pitch = so3_exp(np.array([roll, 0, 0])), so3_exp(np.array([0, pitch, 0]))
    rotation = so3_exp(np.array([0, 0, yaw])) @ turn_pitch @ turn_roll
    in_pitched = turn_pitch.T @ np.array([0, 0, yaw_rate]) + np.array([0, pitch_rate, 0])
    gyro = turn_roll.T @ in_pitched + np.array([roll_rate, 0, 0])
    return Motion(se3(rotation, position), velocity, gyro, rotation.T @ (acceleration - GRAVITY))


def moved_between(first_s: float, second_s: float) -> Array:
    """first_from_second (4, 4) of the body."""
    return se3_inverse(analytic_motion(first_s).map_from_body) @ analytic_motion(second_s).map_from_body


@lru_cache(maxsize=100_000)
def _felt(stamp_ns: int) -> tuple[Array, Array]:
    state = analytic_motion(stamp_ns * 1e-9)
    return state.gyro_radps, state.accel_mps2


def sample_motion(
    *, rate_hz: float, duration_s: float, gyro_bias: Array | None = None, accel_bias: Array | None = None
) -> ImuSamples:
    """Noise-free samples from time 0 to `duration_s`, both included."""
    stamps = np.round(np.arange(round(duration_s * rate_hz) + 1) * 1e9 / rate_hz).astype(np.int64)
    felt = np.array([_felt(int(s)) for s in stamps]).transpose(1, 0, 2)
    biases = (np.zeros(3) if bias is None else bias for bias in (gyro_bias, accel_bias))
    return ImuSamples(stamps, *(values + bias for values, bias in zip(felt, biases, strict=True)))


def corrected(summed: Preintegrated, gyro_bias: Array, accel_bias: Array) -> tuple[Array, Array, Array]:
    """Increments (3, 3), (3,), (3,) for other biases, to first order. Source: Forster et al. 2017, eq. 44."""
    gyro, accel = gyro_bias - summed.gyro_bias_radps, accel_bias - summed.accel_bias_mps2
    return (
        summed.delta_rotation @ so3_exp(summed.d_rotation_d_gyro @ gyro),
        summed.delta_velocity_mps + summed.d_velocity_d_gyro @ gyro + summed.d_velocity_d_accel @ accel,
        summed.delta_position_m + summed.d_position_d_gyro @ gyro + summed.d_position_d_accel @ accel,
    )


def predicted(
    summed: Preintegrated, map_from_body: Array, velocity_map_mps: Array, gyro_bias: Array, accel_bias: Array
) -> tuple[Array, Array]:
    """map_from_body (4, 4) and velocity (3,) at the end from those at the start, in a gravity-aligned frame."""
    rotation, velocity, position = corrected(summed, gyro_bias, accel_bias)
    map_from_start, dt = map_from_body[:3, :3], summed.dt_s
    moved = map_from_body[:3, 3] + velocity_map_mps * dt + 0.5 * GRAVITY_MAP * dt**2 + map_from_start @ position
    after = velocity_map_mps + GRAVITY_MAP * dt + map_from_start @ velocity
    return se3(map_from_start @ rotation, moved), np.asarray(after)
