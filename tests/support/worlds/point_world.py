"""A room of points seen along the analytic motion: the filter without pictures."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log, transform_points
from fleetmap.odometry.filter.msckf import InvariantFilter, NavState
from fleetmap.odometry.settings import FilterSettings
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import ImuSamples
from support.worlds.inertial_motion import analytic_motion, sample_motion

CAMERA = StereoCamera(300.0, 320.0, 240.0, 0.12, 640, 480)
BODY_FROM_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.05, 0.03, 0.02]))
SECOND = StereoCamera(260.0, 300.0, 250.0, 0.08, 640, 480)  # of another lens, that looks aside
BODY_FROM_SECOND = se3(so3_exp(np.array([0.1, 0.05, 0.7])) @ BODY_FROM_CAM[:3, :3], np.array([0.02, 0.2, -0.1]))
CAMERAS = [(CAMERA, BODY_FROM_CAM), (SECOND, BODY_FROM_SECOND)]
NOISE = ImuNoise(2e-3, 1e-4, 2e-2, 1e-3)
# white noise of the size that measurements are weighed by, and nothing else
SETTINGS = FilterSettings(
    chi_square_share=0.999, noise_share=1.0, slip_along_share=0.0, slip_across_share=0.0, track_disparity_sigma_px=0.0,
    disparity_offset_sigma_px=0.0, depth_scale_sigma=0.0,
)  # fmt: skip
IMU_RATE_HZ = 200.0
FRAME_S = 0.1


def room(rng: np.random.Generator, count: int = 400) -> Array:
    """points_map (N, 3) on the walls of a room around the motion."""
    angle = rng.uniform(0, 2 * np.pi, count)
    distance = rng.uniform(3.0, 6.0, count)
    return np.column_stack([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(-2, 2, count)])


def true_state(time_s: float, gyro_bias: Array | None = None, accel_bias: Array | None = None) -> NavState:
    """The analytic motion as a filter's state."""
    truth = analytic_motion(time_s)
    return NavState(
        truth.map_from_body[:3, :3].copy(),
        truth.velocity_map_mps.copy(),
        truth.map_from_body[:3, 3].copy(),
        np.zeros(3) if gyro_bias is None else gyro_bias.copy(),
        np.zeros(3) if accel_bias is None else accel_bias.copy(),
    )


def perturbed(state: NavState, rotation: Array, error: Array) -> NavState:
    """The state with true = Exp(error) * state undone: `rotation` is Exp(error[:3])."""
    back = rotation.T
    return NavState(
        back @ state.rotation,
        back @ (state.velocity_mps - error[3:6]),
        back @ (state.position_m - error[6:9]),
        state.gyro_bias_radps - error[9:12],
        state.accel_bias_mps2 - error[12:15],
    )


def error_of(state: NavState, truth: NavState) -> Array:
    """(15,) right-invariant error: truth = Exp(error) * state."""
    turn = truth.rotation @ state.rotation.T
    return np.concatenate(
        [
            so3_log(turn),
            truth.velocity_mps - turn @ state.velocity_mps,
            truth.position_m - turn @ state.position_m,
            truth.gyro_bias_radps - state.gyro_bias_radps,
            truth.accel_bias_mps2 - state.accel_bias_mps2,
        ]
    )


def noisy_imu(
    rng: np.random.Generator, duration_s: float, noise: ImuNoise, gyro_bias: Array, accel_bias: Array
) -> ImuSamples:
    """The analytic motion's samples with white noise and constant biases."""
    clean = sample_motion(rate_hz=IMU_RATE_HZ, duration_s=duration_s)
    root_rate = np.sqrt(IMU_RATE_HZ)
    shape = clean.gyro_radps.shape
    return ImuSamples(
        clean.stamps_ns,
        clean.gyro_radps + gyro_bias + noise.gyro_noise_radps_rthz * root_rate * rng.normal(size=shape),
        clean.accel_mps2 + accel_bias + noise.accel_noise_mps2_rthz * root_rate * rng.normal(size=shape),
    )


def observe(points_map: Array, time_s: float, rng: np.random.Generator | None, number: int = 0) -> Array:
    """(N, 3) u_left v u_right with the filter's noise (none without a generator) in a camera; NaN where not in view."""
    camera, body_from_cam = CAMERAS[number]
    cam_from_map = se3_inverse(analytic_motion(time_s).map_from_body @ body_from_cam)
    pixels = camera.pixel_from_point(transform_points(cam_from_map, points_map))
    disparity = pixels[:, 0] - pixels[:, 2]
    if rng is not None:
        pixels[:, :2] += SETTINGS.pixel_sigma_px * rng.normal(size=(len(pixels), 2))
        disparity = disparity + SETTINGS.disparity_sigma_px * rng.normal(size=len(pixels))
    pixels[:, 2] = pixels[:, 0] - disparity
    with np.errstate(invalid="ignore"):
        seen = (pixels[:, 0] > 0) & (pixels[:, 0] < 640) & (pixels[:, 1] > 0) & (pixels[:, 1] < 480) & (disparity > 1)
    pixels[~seen] = np.nan
    return np.asarray(pixels)


def use(
    estimate: InvariantFilter, seen: dict[int, Array], chosen: Array, iterations: int = 1, newest: Array | None = None,
    first_depth_m: float = 5.0,
) -> NDArray[np.int8]:  # fmt: skip
    """Updates by what frames (index -> pixels (N, 3)) saw of the chosen points; those in view of two or more."""
    for frame, pixels in seen.items():
        visible = chosen[np.isfinite(pixels[chosen, 0])]
        estimate.observe(frame, 0, visible, pixels[visible])
    return estimate.update(np.zeros(0, np.int64), np.zeros(0, bool), first_depth_m, iterations, newest)


class Run(NamedTuple):
    """Result of one run."""

    filter: InvariantFilter
    truth: NavState
    accepted_share: float


def run_filter(
    rng: np.random.Generator, nav_covariance: Array, start_error: Array, *, duration_s: float, noise: ImuNoise = NOISE,
    gyro_bias: Array | None = None, accel_bias: Array | None = None, imu_minus_cam_s: float = 0.0, settings: FilterSettings = SETTINGS,
) -> Run:  # fmt: skip
    """A filter along the motion; every few frames a share of the points serves, each observation once.

    start_error (15,) is what the filter begins with. imu_minus_cam_s: pictures are stamped that much too early.
    """
    gyro_bias = np.zeros(3) if gyro_bias is None else gyro_bias
    accel_bias = np.zeros(3) if accel_bias is None else accel_bias
    imu = noisy_imu(rng, duration_s + 0.2, noise, gyro_bias, accel_bias)
    begin_s = 0.05  # so that no picture is stamped before the state begins
    truth = true_state(begin_s, gyro_bias, accel_bias)
    start = perturbed(truth, so3_exp(start_error[:3]), start_error)
    estimate = InvariantFilter(start, nav_covariance, settings, CAMERAS)
    points = room(rng)
    seen: dict[int, Array] = {}
    state_ns, accepted, offered = round(begin_s * 1e9), 0, 0
    for index in range(round(duration_s / FRAME_S)):
        time_s = (index + 1) * FRAME_S
        stamp_ns = round((time_s - imu_minus_cam_s) * 1e9)
        target_ns = max(stamp_ns + round(estimate.imu_minus_cam_s * 1e9), state_ns)
        rate = estimate.propagate(imu, state_ns, target_ns, noise)
        state_ns = target_ns
        estimate.add_clone(index, rate)
        seen[index] = observe(points, time_s, rng)
        if index % 5 == 4:
            used = use(estimate, seen, rng.choice(len(points), 300, replace=False))
            accepted, offered = accepted + int((used == 1).sum()), offered + len(used)
            for old in list(seen)[:-1]:
                estimate.remove_clone(old)
            seen = {index: np.full_like(seen[index], np.nan)}  # each observation once
    truth = true_state(state_ns * 1e-9, gyro_bias, accel_bias)
    return Run(estimate, truth, accepted / max(offered, 1))
