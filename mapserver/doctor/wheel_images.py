"""The wheels against the images: speed, direction and yaw rate of the base."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.sensors.samples import WheelSample
from mapserver.doctor.gyro_images import CameraTurns

_LEAST_MPS, _LEAST_RADPS = 0.1, 0.1  # below, a robot may as well rest
_MIN_MOVING = 5
_SAMPLES = 5  # of an interval
_SURE_SIGMAS = 5.0


@dataclass(frozen=True, slots=True)
class WheelFit:
    """Wheels over images: medians, which a minority of slips and of people in the pictures does not move.

    speed: complex, forward and left: -1 for wheels that count backwards, 1j for a base that is turned by 90 degrees. yaw: of the rates.
    Both 0 for wheels that rest while the images move, infinite for images that rest, None where too little moves. speed_sigma: of its size.
    image_mps, wheel_mps: median speeds where one of them moves.
    """

    speed: complex | None
    speed_sigma: float
    yaw: float | None
    image_mps: float
    wheel_mps: float


def fit_wheels(
    turns: CameraTurns, wheel: Sequence[WheelSample], base_from_body: Array, imu_minus_cam_s: float
) -> WheelFit:
    """The wheels over what the images say of the same intervals; wheels are on the IMU's clock."""
    seen: list[Array] = []
    rolled: list[Array] = []
    stamps_s = (np.array([sample.stamp_ns for sample in wheel], np.int64) - wheel[0].stamp_ns) * 1e-9
    columns = np.array([[*sample.velocity_base_mps[:2], sample.yaw_rate_radps] for sample in wheel]).T
    spans_s = (np.stack([turns.starts_ns, turns.ends_ns], axis=1) - wheel[0].stamp_ns) * 1e-9 + imu_minus_cam_s
    for (start_s, end_s), rate, way_m in zip(spans_s, turns.rates_body_radps, turns.ways_m, strict=True):
        if start_s < stamps_s[0] or end_s > stamps_s[-1]:
            continue
        turn = rate * (end_s - start_s)
        base = base_from_body @ se3(so3_exp(turn), way_m) @ se3_inverse(base_from_body)
        turn_base = base_from_body[:3, :3] @ turn
        way_base = so3_exp(-0.5 * turn_base) @ base[:3, 3]
        seen.append(np.array([way_base[0], way_base[1], turn_base[2]]) / (end_s - start_s))
        times = np.linspace(start_s, end_s, _SAMPLES)
        rolled.append(np.array([np.interp(times, stamps_s, column).mean() for column in columns]))
    by_images, by_wheels = (np.array(each).reshape(-1, 3) for each in (seen, rolled))
    speeds = by_images[:, 0] + 1j * by_images[:, 1], by_wheels[:, 0] + 1j * by_wheels[:, 1]
    moving = np.fmax(np.abs(speeds[0]), np.abs(speeds[1])) > _LEAST_MPS
    image_mps, wheel_mps = (float(np.median(np.abs(each[moving]))) if moving.any() else 0.0 for each in speeds)
    speed, sigma = _ratio(*speeds, _LEAST_MPS)
    yaw, _ = _ratio(by_images[:, 2], by_wheels[:, 2], _LEAST_RADPS)
    return WheelFit(speed, sigma, None if yaw is None else yaw.real, image_mps, wheel_mps)


def _ratio(seen: Array, rolled: Array, least: float) -> tuple[complex | None, float]:
    """Wheels over images, and the sigma of its size: where the wheels move, or else where the images do."""
    known = np.isfinite(seen)
    drives, moves = known & (np.abs(rolled) > least), known & (np.abs(seen) > least)
    if drives.sum() >= _MIN_MOVING:
        shares = seen[drives] / rolled[drives]
        median = complex(np.median(shares.real), np.median(shares.imag))
        sigma = 1.25 * 1.4826 * float(np.median(np.abs(shares - median))) / float(np.sqrt(len(shares)))
        if abs(median) <= _SURE_SIGMAS * sigma:
            return complex(np.inf), np.inf
        return 1.0 / median, sigma / abs(median) ** 2
    if moves.sum() >= _MIN_MOVING:
        return complex(np.median((rolled[moves] / seen[moves]).real)), 0.0
    return None, np.inf
