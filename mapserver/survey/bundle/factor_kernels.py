"""Linearisation of pose priors, relative poses and inertial edges (Forster et al. 2017). Conventions: problem.py."""

from typing import NamedTuple

import numpy as np

from fleetmap.geometry import AnyArray, Array
from fleetmap.inertial.so3_kernels import (
    inverse_left_jacobian_into,
    log_into,
    matmul3,
    matmul3_skew,
    matmul3_transposed,
    matvec3,
    matvec3_transposed,
    right_jacobian_into,
)
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import exp_into

Moment = tuple[Array, Array, Array]
"""Rotation (3, 3), position (3,) and motion (9,) of a keyframe: velocity, gyro bias, accelerometer bias."""


class Measurement(NamedTuple):
    """A measured rotation (3, 3) and translation (3,), and the information (6, 6) of its error."""

    rotation: Array
    translation_m: Array
    information: Array


@kernel
def quadratic(jacobian: Array, residual: Array, information: Array, block: Array, rhs: Array) -> float:
    """block = J^T I J, rhs = -J^T I r; returns r^T I r / 2."""
    rows, columns = jacobian.shape
    weighted = np.zeros((rows, columns))
    cost = 0.0
    rhs[:] = 0.0
    for a in range(rows):
        pull = 0.0
        for b in range(rows):
            value = information[a, b]
            pull += value * residual[b]
            for c in range(columns):
                weighted[a, c] += value * jacobian[b, c]
        cost += 0.5 * residual[a] * pull
        for c in range(columns):
            rhs[c] -= jacobian[a, c] * pull
    block[:, :] = 0.0
    for a in range(rows):
        for c in range(columns):
            value = jacobian[a, c]
            if value != 0.0:
                for d in range(columns):
                    block[c, d] += value * weighted[a, d]
    return cost


@kernel
def linearise_prior(rotation: Array, position_m: Array, prior: Measurement, block: Array, rhs: Array) -> float:
    """Cost of one pose prior; fills block (6, 6) and rhs (6,)."""
    residual, jacobian = np.empty(6), np.zeros((6, 6))
    off = rotation @ prior.rotation.T
    log_into(off, residual[:3])
    inverse_left_jacobian_into(residual[:3], jacobian[:3, :3])
    for a in range(3):
        residual[3 + a] = position_m[a] - prior.translation_m[a]
        jacobian[3 + a, 3 + a] = 1.0
    return quadratic(jacobian, residual, prior.information, block, rhs)


@kernel
def linearise_relative(
    rotations: Array, positions_m: Array, ends: tuple[int, int], relative: Measurement, block: Array, rhs: Array
) -> float:
    """Cost of one relative pose; fills block (12, 12) and rhs (12,) over keyframes i, j."""
    (i, j), (residual, jacobian) = ends, (np.empty(6), np.zeros((6, 12)))
    rot_i, between, off, inverse = rotations[i], np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    turned, lever = np.empty((3, 3)), np.empty((3, 3))
    matmul3_transposed(rot_i, rotations[j], between)
    matmul3(between, np.ascontiguousarray(relative.rotation.T), off)
    log_into(off, residual[:3])
    apart = positions_m[j] - positions_m[i]
    matvec3_transposed(rot_i, apart, residual[3:])
    inverse_left_jacobian_into(residual[:3], inverse)
    i_from_map = np.ascontiguousarray(rot_i.T)
    matmul3(inverse, i_from_map, turned)
    matmul3_skew(i_from_map, apart, lever)
    for a in range(3):
        residual[3 + a] -= relative.translation_m[a]
        for b in range(3):
            jacobian[a, b] = -turned[a, b]
            jacobian[a, 6 + b] = turned[a, b]
            jacobian[3 + a, b] = lever[a, b]
            jacobian[3 + a, 3 + b] = -i_from_map[a, b]
            jacobian[3 + a, 9 + b] = i_from_map[a, b]
    return quadratic(jacobian, residual, relative.information, block, rhs)


@kernel
def inertial_residual(
    i: Moment, j: Moment, gravity: Array, increments: Array, residual: Array, jacobian: Array
) -> None:
    """Residual (15,) and Jacobian (15, 30) of one inertial edge over [pose, velocity, biases] of i and of j.

    increments (67,): dt, dR, dv, dp, the five bias derivatives and the biases they
    were taken at. Residual order: rotation, velocity, position, biases. Source: Forster et al. 2017, eq. 45.
    """
    (rot_i, pos_i, motion_i), (rot_j, pos_j, motion_j) = i, j
    dt_s, delta_rot = increments[0], increments[1:10].reshape(3, 3)
    rot_by_gyro, vel_by_gyro = increments[16:25].reshape(3, 3), increments[25:34].reshape(3, 3)
    vel_by_accel = increments[34:43].reshape(3, 3)
    pos_by_gyro, pos_by_accel = increments[43:52].reshape(3, 3), increments[52:61].reshape(3, 3)
    gyro, accel = motion_i[3:6] - increments[61:64], motion_i[6:9] - increments[64:67]
    bend, turn, corrected = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    between, off, inverse = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    part, other, velocity_lever, position_lever = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    matvec3(rot_by_gyro, gyro, bend)
    exp_into(bend, turn)
    matmul3(delta_rot, turn, corrected)
    matmul3_transposed(rot_i, rot_j, between)
    matmul3_transposed(corrected, between, off)
    log_into(off, residual[0:3])
    i_from_map = np.ascontiguousarray(rot_i.T)
    faster, farther, felt = np.empty(3), np.empty(3), np.empty(3)
    for a in range(3):
        faster[a] = motion_j[a] - motion_i[a] - gravity[a] * dt_s
        farther[a] = pos_j[a] - pos_i[a] - motion_i[a] * dt_s - 0.5 * gravity[a] * dt_s * dt_s
    matvec3(i_from_map, faster, residual[3:6])
    matvec3(vel_by_gyro, gyro, felt)
    residual[3:6] -= felt + increments[10:13]
    matvec3(vel_by_accel, accel, felt)
    residual[3:6] -= felt
    matvec3(i_from_map, farther, residual[6:9])
    matvec3(pos_by_gyro, gyro, felt)
    residual[6:9] -= felt + increments[13:16]
    matvec3(pos_by_accel, accel, felt)
    residual[6:9] -= felt
    residual[9:15] = motion_j[3:9] - motion_i[3:9]
    jacobian[:, :] = 0.0
    inverse_left_jacobian_into(residual[0:3], inverse)
    inverse = np.ascontiguousarray(inverse.T)  # the inverse right Jacobian
    matmul3(inverse, np.ascontiguousarray(rot_j.T), part)
    jacobian[0:3, 0:3] = -part
    jacobian[0:3, 15:18] = part
    right_jacobian_into(bend, turn)
    matmul3(turn, rot_by_gyro, part)
    matmul3_transposed(off, part, other)
    matmul3(inverse, other, part)
    jacobian[0:3, 9:12] = -part
    matmul3_skew(i_from_map, faster, velocity_lever)
    matmul3_skew(i_from_map, farther, position_lever)
    jacobian[3:6, 0:3] = velocity_lever
    jacobian[3:6, 6:9] = -i_from_map
    jacobian[3:6, 21:24] = i_from_map
    jacobian[3:6, 9:12] = -vel_by_gyro
    jacobian[3:6, 12:15] = -vel_by_accel
    jacobian[6:9, 0:3] = position_lever
    jacobian[6:9, 3:6] = -i_from_map
    jacobian[6:9, 18:21] = i_from_map
    jacobian[6:9, 6:9] = -dt_s * i_from_map
    jacobian[6:9, 9:12] = -pos_by_gyro
    jacobian[6:9, 12:15] = -pos_by_accel
    for a in range(6):
        jacobian[9 + a, 9 + a] = -1.0
        jacobian[9 + a, 24 + a] = 1.0


@kernel
def linearise_inertial(
    variables: tuple[Array, Array, Array],
    gravity: Array,
    ends: AnyArray,
    edges: tuple[Array, Array],
    blocks: Array,
    rhs: Array,
) -> float:
    """Cost of all inertial edges; fills blocks (E, 30, 30) and rhs (E, 30). ends (E, 2), informations (E, 15, 15)."""
    rotations, positions_m, motions = variables
    increments, informations = edges
    residual, jacobian = np.empty(15), np.empty((15, 30))
    cost = 0.0
    for e in range(len(ends)):
        i, j = ends[e, 0], ends[e, 1]
        first, second = (rotations[i], positions_m[i], motions[i]), (rotations[j], positions_m[j], motions[j])
        inertial_residual(first, second, gravity, increments[e], residual, jacobian)
        cost += quadratic(jacobian, residual, informations[e], blocks[e], rhs[e])
    return cost
