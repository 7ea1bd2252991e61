"""Propagation of the right-invariant filter through IMU samples; error convention of `msckf_kernels`."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.inertial.preintegration_kernels import intervals
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import exp_so3, matmul, matmul_nt, rotate, skew
from fleetmap.odometry.filter.covariance_kernels import forget, transition
from fleetmap.odometry.filter.state_kernels import State
from fleetmap.sensors.samples import Stamps


@kernel
def predict(
    state: State,
    gravity: Array,
    stamps_ns: Stamps,
    gyro: Array,
    accel: Array,
    start_ns: int,
    end_ns: int,
    noises: Array,
    covariance: Array,
    true_error_cov: Array,
    considered: int,
    kept: float,
    added: Array,
) -> Array:
    """Moves the state and both covariances through samples (N,), (N, 3), by the first and the second noise; in place.

    The last angular rate (3,), bias removed. considered: how many errors of the second covariance come before the state's; kept and
    added as of `forget`. Other arguments as of `propagate`.
    """
    steps_s, rates, forces = intervals(stamps_ns, gyro, accel, start_ns, end_ns)
    phi, processes = np.eye(15), np.zeros((2, 15, 15))
    if len(steps_s) > 0:
        propagate(state, gravity, steps_s, rates, forces, noises, phi, processes)
    transition(covariance, 0, phi, processes[0])
    transition(true_error_cov, considered, phi, processes[1])
    forget(true_error_cov, kept, added)
    return rates[len(rates) - 1] - state.gyro_bias if len(rates) > 0 else np.zeros(3)


@kernel
def propagate(
    state: State,
    gravity: Array,
    steps_s: Array,
    gyro: Array,
    accel: Array,
    noises: Array,
    state_to_state: Array,
    processes: Array,
) -> None:
    """Moves the state (in place) through N intervals of constant rate and specific force.

    steps_s (N,), gyro and accel (N, 3) at each interval's middle. noises (D, 4): densities of gyro, accel, gyro walk,
    accel walk, as so many may judge them. state_to_state (15, 15) and processes (D, 15, 15) receive the accumulated error
    transition and, for each of the judgements, the noise, order r nu rho bg ba.
    """
    rotation, velocity, position = state.rotation, state.velocity, state.position
    gyro_bias, accel_bias = state.gyro_bias, state.accel_bias
    phi = np.eye(15)
    processes[:, :, :] = 0.0
    for n in range(len(steps_s)):
        dt = steps_s[n]
        rate = gyro[n] - gyro_bias
        middle = matmul(rotation, exp_so3(0.5 * dt * rate))
        acceleration = rotate(middle, accel[n] - accel_bias) + gravity
        step = np.eye(15)
        g = skew(gravity)
        step[3:6, 0:3] = g * dt
        step[6:9, 0:3] = 0.5 * dt * dt * g
        step[6:9, 3:6] = np.eye(3) * dt
        mid_velocity = velocity + 0.5 * dt * acceleration
        mid_position = position + 0.5 * dt * velocity
        lever_v, lever_p = matmul(skew(mid_velocity), middle), matmul(skew(mid_position), middle)
        # bias columns by the middle of the interval: first order in it, second where the chain r -> nu -> rho needs it
        step[0:3, 9:12] = -middle * dt
        step[3:6, 9:12] = -lever_v * dt - 0.5 * dt * dt * matmul(g, middle)
        step[6:9, 9:12] = -lever_p * dt - 0.5 * dt * dt * lever_v
        step[3:6, 12:15] = -middle * dt
        step[6:9, 12:15] = -0.5 * dt * dt * middle
        shape = np.zeros((15, 6))
        shape[0:3, 0:3], shape[3:6, 0:3], shape[6:9, 0:3] = middle, lever_v, lever_p
        shape[3:6, 3:6] = middle
        phi = matmul(step, phi)
        for d in range(len(noises)):
            processes[d] = matmul_nt(matmul(step, processes[d]), step) + _diffusion(shape, noises[d], dt)
        position += velocity * dt + 0.5 * dt * dt * acceleration
        velocity += acceleration * dt
        rotation[:, :] = matmul(rotation, exp_so3(dt * rate))
    state_to_state[:, :] = phi


@kernel
def _diffusion(shape: Array, noise: Array, duration_s: float) -> Array:
    """(15, 15) noise that one interval adds; shape (9, 6): how gyro and accelerometer enter rotation, velocity, position."""
    diffusion = np.zeros((15, 15))
    for k in range(6):
        density = noise[0] if k < 3 else noise[1]
        for a in range(9):
            for b in range(9):
                diffusion[a, b] += shape[a, k] * shape[b, k] * density * density * duration_s
    for a in range(3):
        diffusion[9 + a, 9 + a] = noise[2] * noise[2] * duration_s
        diffusion[12 + a, 12 + a] = noise[3] * noise[3] * duration_s
    return diffusion
