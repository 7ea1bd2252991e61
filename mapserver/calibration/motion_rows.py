"""Rows of the adjustment that the IMU and the wheels give between neighbouring keyframes."""

from dataclasses import dataclass

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, se3_inverse, skew, so3_exp, so3_log
from fleetmap.inertial import GRAVITY_MAP, imu_intervals, preintegrate
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import wheel_between
from mapserver.calibration.parameters import INDEX, UNKNOWNS, CalibrationParameter
from mapserver.calibration.problem import CalibrationData, MotionState
from mapserver.survey.bundle.factors import FLOOR_SIGMA, packed_increments

_SLIP_MPS = 0.05  # sideways and upwards, which wheels do not measure
_RATE_NS = 5_000_000  # half the time over which the angular rate at a keyframe is averaged
ROTATION, MOTION, WALK, WHEEL = range(4)  # groups of rows


@dataclass(frozen=True)
class Edge:
    """What was measured between keyframes first and first + 1: whitening (n, n) of n rows and their groups (n,)."""

    first: int
    whitening: Array
    groups: Array


@dataclass(frozen=True)
class InertialEdge(Edge):
    """increments (67,) as the core takes them."""

    increments: Array


@dataclass(frozen=True)
class WheelEdge(Edge):
    """way_m (3,): of the wheels in body axes; lever_m (3,): what the turning adds, which no scale changes; base_from_body (3, 3)."""

    way_m: Array
    lever_m: Array
    base_from_body: Array


@dataclass(frozen=True)
class Rows:
    """Whitened rows of one edge: residual (n,), by_keyframes (n, 2 stride), by_calibration (n, C), groups (n,)."""

    first: int
    residual: Array
    by_keyframes: Array
    by_calibration: Array
    groups: Array


def inertial_edges(data: CalibrationData, state: MotionState, offset_s: float, noise: ImuNoise) -> list[InertialEdge]:
    """Preintegrated samples between keyframes at the state's biases; offset_s: correction of the calibration's time offset."""
    if not data.is_inertial:
        return []
    stamps = imu_stamps(data, offset_s)
    edges, groups = [], np.repeat([ROTATION, MOTION, MOTION, WALK, WALK], 3)
    for k in range(len(stamps) - 1):
        summed = preintegrate(
            data.imu, int(stamps[k]), int(stamps[k + 1]), state.motions[k, 3:6], state.motions[k, 6:], noise
        )
        factor = np.linalg.cholesky(summed.cov + np.diag(FLOOR_SIGMA**2))
        edges.append(InertialEdge(k, np.linalg.inv(factor), groups, packed_increments([summed])[0]))
    return edges


def imu_stamps(data: CalibrationData, offset_s: float) -> Array:
    """(K,) stamps of the keyframes on the IMU's clock."""
    given_s = data.calibration.cameras[0].imu_minus_cam_s
    return np.asarray(data.stamps_ns + round((given_s + offset_s) * 1e9), np.int64)


def body_rates(data: CalibrationData, state: MotionState, offset_s: float) -> Array:
    """(K, 3) angular rates of the body at the keyframes in map axes, by the gyro; zero without an IMU."""
    rates = np.zeros((len(data.stamps_ns), 3))
    if not data.is_inertial:
        return rates
    for k, stamp in enumerate(imu_stamps(data, offset_s)):
        dt_s, gyro, _ = imu_intervals(data.imu, int(stamp) - _RATE_NS, int(stamp) + _RATE_NS)
        if len(dt_s):
            rates[k] = state.map_from_body[k, :3, :3] @ (dt_s @ gyro / dt_s.sum() - state.motions[k, 3:6])
    return rates


def wheel_edges(data: CalibrationData, state: MotionState, offset_s: float) -> list[WheelEdge]:
    """What the wheels rolled between keyframes, along the turn that the state has there."""
    if not data.wheel:
        return []
    stamps, base_from_body = imu_stamps(data, offset_s), data.calibration.base_from_body
    base_in_body = se3_inverse(base_from_body)[:3, 3]
    edges, groups = [], np.full(3, WHEEL)
    for k in range(len(stamps) - 1):
        samples = wheel_between(data.wheel, int(stamps[k]), int(stamps[k + 1]))
        dt_s = (stamps[k + 1] - stamps[k]) * 1e-9
        if len(samples) < 2 or (samples[-1].stamp_ns - samples[0].stamp_ns) * 1e-9 < 0.7 * dt_s:
            continue
        turn = so3_log(state.map_from_body[k, :3, :3].T @ state.map_from_body[k + 1, :3, :3])
        shares = _shares([sample.stamp_ns for sample in samples], int(stamps[k]), int(stamps[k + 1]))
        way, variance = np.zeros(3), 0.0
        for sample, (at, share) in zip(samples, shares, strict=True):
            way += share * dt_s * so3_exp(turn * at) @ base_from_body[:3, :3].T @ sample.velocity_base_mps
            variance += (share * dt_s * sample.sigma_mps) ** 2
        # the base moves by R v; the body, which sits elsewhere, by that and the turn of what lies between
        lever = base_in_body - so3_exp(turn) @ base_in_body
        sigma = np.array([np.sqrt(variance), _SLIP_MPS * dt_s, _SLIP_MPS * dt_s])
        turned = base_from_body[:3, :3] @ so3_exp(-0.5 * turn)
        edges.append(WheelEdge(k, np.diag(1.0 / sigma), groups, way, lever, turned))
    return edges


def _shares(sample_ns: list[int], start_ns: int, end_ns: int) -> Array:
    """(n, 2) of each sample, its place between start and end and the share of the time that it stands for."""
    at = (np.array(sample_ns, np.int64) - start_ns) / (end_ns - start_ns)
    bounds = np.concatenate([[0.0], 0.5 * (at[1:] + at[:-1]), [1.0]])
    return np.column_stack([at, np.diff(bounds)])


def inertial_rows(edge: InertialEdge, state: MotionState) -> Rows:
    """Residual and derivatives of an inertial edge."""
    k = edge.first
    ends = slice(k, k + 2)
    residual, jacobian = core.inertial_residual(
        state.map_from_body[ends], state.motions[ends], GRAVITY_MAP, edge.increments
    )
    nothing = np.zeros((15, UNKNOWNS))
    return Rows(k, edge.whitening @ residual, edge.whitening @ jacobian, nothing, edge.groups)


def wheel_rows(edge: WheelEdge, state: MotionState, wheel_scale: float, stride: int) -> Rows:
    """The way of the body from one keyframe to the next in the axes of the base, against that of the wheels."""
    k = edge.first
    body_from_map = state.map_from_body[k, :3, :3].T
    apart = state.map_from_body[k + 1, :3, 3] - state.map_from_body[k, :3, 3]
    whitening = edge.whitening @ edge.base_from_body
    residual = whitening @ (body_from_map @ apart - (1.0 + wheel_scale) * edge.way_m - edge.lever_m)
    by_keyframes, by_calibration = np.zeros((3, 2 * stride)), np.zeros((3, UNKNOWNS))
    by_keyframes[:, :3] = whitening @ body_from_map @ skew(apart)
    by_keyframes[:, 3:6] = -whitening @ body_from_map
    by_keyframes[:, stride + 3 : stride + 6] = whitening @ body_from_map
    by_calibration[:, INDEX[CalibrationParameter.WHEEL_SCALE]] = -whitening @ edge.way_m
    return Rows(k, residual, by_keyframes, by_calibration, edge.groups)
