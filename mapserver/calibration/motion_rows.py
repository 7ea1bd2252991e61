"""Inputs of a calibration estimate; IMU and wheel terms between neighbouring keyframes, and their whitened residuals."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import count, pairwise
from typing import NamedTuple

import numpy as np

from fleetmap import core
from fleetmap.geometry import AnyArray, Array, se3, se3_inverse, so3_exp, so3_exps, so3_log
from fleetmap.inertial import GRAVITY_MAP, Preintegrated, imu_intervals, preintegrate
from fleetmap.sensors.calibration import ImuNoise, RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import ImuSamples, Stamps, WheelSample, wheel_between
from mapserver.calibration.parameters import LENS_SIGMAS
from mapserver.survey.bundle.bundle_adjustment import FLOOR_SIGMA, packed_increments
from mapserver.survey.state import RelativeTerm


@dataclass(frozen=True)
class MotionState:
    """Variables of K keyframes and N landmarks.

    map_from_body (K, 4, 4); motions (K, 9): velocity in map, gyro bias, accelerometer bias, zero without an IMU; points_map (N, 3).
    """

    map_from_body: Array
    motions: Array
    points_map: Array


@dataclass(frozen=True)
class CalibrationData:
    """One stretch of a recording, tracked by a survey under `calibration`, with the `rectifier` of that calibration.

    stamps_ns (K,) on the cameras' clock. Observations are sorted by landmark: obs_keyframe, obs_landmark (M,); obs_pixels (M, 4) of
    the rectified pair: u_left, v_left, u_right, v_right, the last two NaN without a match in the right image. obs_sigma_px (M, 3): of the
    left pixel, of the disparity, of the row difference. imu: empty if absent. bias_px: possible common error of pixels and disparities,
    which does not average out. lens_sigmas: of the given distortion.
    """

    calibration: RigCalibration
    rectifier: Rectifier
    stamps_ns: Stamps
    start: MotionState
    obs_keyframe: AnyArray
    obs_landmark: AnyArray
    obs_pixels: Array
    obs_sigma_px: Array
    imu: ImuSamples
    wheel: Sequence[WheelSample] = ()
    bias_px: float = 0.0
    lens_sigmas: Array = field(default_factory=lambda: LENS_SIGMAS)

    @property
    def is_inertial(self) -> bool:
        """True if the data include an IMU."""
        return self.calibration.imu is not None and len(self.imu) > 0


_SLIP_MPS = 0.05  # sideways and upwards, which wheels do not measure
_RATE_NS = 5_000_000  # half the time over which the angular rate at a keyframe is averaged


class InertialEdge(NamedTuple):
    """Samples between keyframes first and first + 1, as the core takes them; root (15, 15): lower triangle of their covariance."""

    first: int
    summed: Preintegrated
    increments: Array
    root: Array

    def residual(self, state: MotionState) -> Array:
        """Return (15,) whitened: rotation, motion, and change of the biases."""
        ends = slice(self.first, self.first + 2)
        moments = state.map_from_body[ends], state.motions[ends]
        residual, _ = core.inertial_residual(*moments, GRAVITY_MAP, self.increments)
        return np.asarray(np.linalg.solve(self.root, residual))

    def believed(self, rotation: float, motion: float) -> Preintegrated:
        """Return the samples with information of rotation and motion scaled by these factors."""
        if rotation == motion == 1.0:
            return self.summed
        root = self.root / np.sqrt(np.repeat([rotation, motion, 1.0], [3, 6, 6]))
        return replace(self.summed, cov=root @ root.T - np.diag(FLOOR_SIGMA**2))


class WheelEdge(NamedTuple):
    """Wheel displacement between keyframes first and first + 1.

    way_m (3,): in body axes; lever_m (3,): part due to the rotation, independent of scale. whitening (3, 3): forward, and slip.
    """

    first: int
    way_m: Array
    lever_m: Array
    whitening: Array

    def residual(self, state: MotionState, wheel_scale: float) -> Array:
        """Return (3,) whitened displacement of the body in the axes of the base minus that of the wheels."""
        here, there = state.map_from_body[self.first : self.first + 2]
        way_m = here[:3, :3].T @ (there[:3, 3] - here[:3, 3])
        return np.asarray(self.whitening @ (way_m - (1.0 + wheel_scale) * self.way_m - self.lever_m))

    def term(self, share: float) -> RelativeTerm:
        """Return the displacement as a relative pose without rotation; it is weighted by share along the way."""
        whitening, information = np.sqrt([[share], [1.0], [1.0]]) * self.whitening, np.zeros((6, 6))
        information[3:, 3:] = whitening.T @ whitening
        return RelativeTerm(self.first, self.first + 1, se3(np.eye(3), self.way_m + self.lever_m), information)


def inertial_edges(data: CalibrationData, state: MotionState, offset_s: float, noise: ImuNoise) -> list[InertialEdge]:
    """Return preintegrated samples between keyframes at the state's biases; offset_s: correction of the calibration's time offset."""
    if not data.is_inertial:
        return []
    stamps, biases = imu_stamps(data, offset_s).tolist(), state.motions[:, 3:].reshape(-1, 2, 3)
    spans = zip(pairwise(stamps), biases, strict=False)
    summed = [preintegrate(data.imu, *ends, bias[0], bias[1], noise) for ends, bias in spans]
    roots = np.linalg.cholesky(np.array([each.cov for each in summed]).reshape(-1, 15, 15) + np.diag(FLOOR_SIGMA**2))
    return list(map(InertialEdge, count(), summed, packed_increments(summed), roots))


def imu_stamps(data: CalibrationData, offset_s: float) -> Array:
    """Return (K,) stamps of the keyframes on the IMU's clock."""
    given_s = data.calibration.cameras[0].imu_minus_cam_s
    return np.asarray(data.stamps_ns + round((given_s + offset_s) * 1e9), np.int64)


def body_rates(data: CalibrationData, state: MotionState, offset_s: float) -> Array:
    """Return (K, 3) angular rates of the body at the keyframes in map axes, by the gyro; zero without an IMU."""
    rates = np.zeros((len(data.stamps_ns), 3))
    if not data.is_inertial:
        return rates
    for k, stamp in enumerate(imu_stamps(data, offset_s)):
        dt_s, gyro, _ = imu_intervals(data.imu, int(stamp) - _RATE_NS, int(stamp) + _RATE_NS)
        if len(dt_s):
            rates[k] = state.map_from_body[k, :3, :3] @ (dt_s @ gyro / dt_s.sum() - state.motions[k, 3:6])
    return rates


def wheel_edges(data: CalibrationData, state: MotionState, offset_s: float, scale: float) -> list[WheelEdge]:
    """Return wheel displacements between keyframes, with the rotation of the state. scale: of the sigma along the way."""
    if not data.wheel:
        return []
    stamps, base_from_body = imu_stamps(data, offset_s), data.calibration.base_from_body
    base_in_body = se3_inverse(base_from_body)[:3, 3]
    edges = []
    for k in range(len(stamps) - 1):
        samples = wheel_between(data.wheel, int(stamps[k]), int(stamps[k + 1]))
        dt_s = (stamps[k + 1] - stamps[k]) * 1e-9
        if len(samples) < 2 or (samples[-1].stamp_ns - samples[0].stamp_ns) * 1e-9 < 0.7 * dt_s:
            continue
        turn = so3_log(state.map_from_body[k, :3, :3].T @ state.map_from_body[k + 1, :3, :3])
        at = np.array([sample.stamp_ns - stamps[k] for sample in samples]) / (stamps[k + 1] - stamps[k])
        share = np.diff([0.0, *0.5 * (at[1:] + at[:-1]), 1.0])
        ways = np.array([sample.velocity_base_mps for sample in samples]) @ base_from_body[:3, :3]
        way = dt_s * share @ (so3_exps(at[:, None] * turn) @ ways[:, :, None])[..., 0]
        sigma_m = float(np.linalg.norm(dt_s * share * [sample.sigma_mps for sample in samples]))
        # the base moves by R v; the body also by the rotation of the lever between them
        sigma = np.array([scale * sigma_m, _SLIP_MPS * dt_s, _SLIP_MPS * dt_s])
        turned = base_from_body[:3, :3] @ so3_exp(-0.5 * turn)
        edges.append(WheelEdge(k, way, base_in_body - so3_exp(turn) @ base_in_body, turned / sigma[:, None]))
    return edges
