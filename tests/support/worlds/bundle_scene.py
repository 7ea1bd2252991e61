"""A small stereo-inertial scene with known truth, and what bundle adjustment minimises written again, plainly."""

from dataclasses import dataclass, replace

import numpy as np

from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp, so3_log, transform_points
from fleetmap.inertial import GRAVITY_MAP, preintegrate
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.bundle.problem import OBSERVED, BundleProblem, InertialTerms
from mapserver.survey.rig import CameraKind, Rig
from support.worlds.inertial_motion import analytic_motion, corrected, sample_motion

CAMERA = StereoCamera(focal_px=400.0, cx_px=320.0, cy_px=240.0, baseline_m=0.12, width_px=640, height_px=480)
BODY_FROM_CAM = se3(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ so3_exp(np.array([0.02, -0.03, 0.01])),
    np.array([0.1, 0.05, -0.02]),
)
GYRO_BIAS, ACCEL_BIAS = np.array([0.01, -0.02, 0.015]), np.array([0.1, -0.05, 0.08])
NOISE = ImuNoise()
ONE = np.eye(4)[None]


def rig(body_from_others: Array = ONE, camera: StereoCamera = CAMERA, body_from_cam: Array = BODY_FROM_CAM) -> Rig:
    """Cameras that see what the first one would see with the body at each of body_from_others (V, 4, 4)."""
    return Rig(camera, body_from_others @ body_from_cam, (CameraKind.STEREO,) * len(body_from_others))


@dataclass(frozen=True)
class Scene:
    """A problem at the truth, with its truth."""

    problem: BundleProblem
    velocities_map_mps: Array
    times_s: Array


def make_scene(
    *,
    keyframes: int,
    landmarks: int,
    step_s: float,
    seed: int,
    noise_px: float = 0.0,
    inertial: bool = False,
    mono_share: float = 0.2,
    body_from_others: Array = ONE,
) -> Scene:
    """Keyframes along the analytic motion, landmarks all around; every visible one is observed, by each camera of a `rig`."""
    rng = np.random.default_rng(seed)
    times = 0.5 + step_s * np.arange(keyframes)
    states = [analytic_motion(t) for t in times]
    map_from_body = np.array([s.map_from_body for s in states])
    away = rng.normal(size=(landmarks, 3)) * [1, 1, 0.4]
    points = away / np.linalg.norm(away, axis=1)[:, None] * rng.uniform(4, 9, (landmarks, 1))
    seen, cameras = [], rig(body_from_others)
    map_from_cams = cameras.map_from_cams(map_from_body)
    for k, c in np.ndindex(map_from_cams.shape[:2]):
        inside = transform_points(se3_inverse(map_from_cams[k, c]), points)
        pixels = CAMERA.pixel_from_point(inside)
        visible = (
            (inside[:, 2] > 0.5) & (pixels[:, 0] > 0) & (pixels[:, 0] < 640) & (pixels[:, 1] > 0) & (pixels[:, 1] < 480)
        )
        seen += [(k, n, c, *pixels[n]) for n in np.nonzero(visible)[0]]
    table = np.array(seen)[rng.permutation(len(seen))]
    counts = np.bincount(table[:, 1].astype(int), minlength=landmarks)
    table = table[counts[table[:, 1].astype(int)] >= 2]
    pixels = table[:, 3:].copy()
    sigma = np.stack([rng.uniform(0.4, 1.0, len(table)), rng.uniform(0.3, 0.8, len(table))], axis=1)
    noise = rng.normal(size=(len(table), 3)) * noise_px
    pixels[:, :2] += noise[:, :2] * sigma[:, :1]
    pixels[:, 2] += noise[:, 0] * sigma[:, 0] - noise[:, 2] * sigma[:, 1]
    pixels[rng.random(len(table)) < mono_share, 2] = np.nan
    fixed = np.zeros(keyframes, np.bool_)
    fixed[0] = True
    velocities = np.array([s.velocity_map_mps for s in states])
    problem = BundleProblem(
        rig=cameras,
        map_from_body=map_from_body,
        fixed=fixed,
        points_map=points,
        obs_keyframe=table[:, 0].astype(np.int32),
        obs_camera=table[:, 2].astype(np.int32),
        obs_landmark=table[:, 1].astype(np.int32),
        obs_pixels=pixels,
        obs_sigma_px=sigma,
    )
    if inertial:
        problem.inertial = _inertial_terms(times, velocities)
    return Scene(problem, velocities, times)


def _inertial_terms(times: Array, velocities: Array) -> InertialTerms:
    imu = sample_motion(rate_hz=200.0, duration_s=float(times[-1]) + 0.1, gyro_bias=GYRO_BIAS, accel_bias=ACCEL_BIAS)
    stamps = np.round(times * 1e9).astype(np.int64)
    edges = [
        (k, k + 1, preintegrate(imu, int(stamps[k]), int(stamps[k + 1]), GYRO_BIAS, ACCEL_BIAS, NOISE))
        for k in range(len(times) - 1)
    ]
    biases = np.tile(np.r_[GYRO_BIAS, ACCEL_BIAS], (len(times), 1))
    return InertialTerms(np.column_stack([velocities, biases]), edges)


def disturbed(problem: BundleProblem, *, seed: int, rot_rad: float, trans_m: float, points_m: float) -> BundleProblem:
    """`problem` with poses (but for held ones) and points moved away."""
    rng = np.random.default_rng(seed)
    moved = problem.map_from_body.copy()
    for k in np.nonzero(~problem.fixed)[0]:
        moved[k] = moved[k] @ se3_exp(np.concatenate([rng.normal(size=3) * rot_rad, rng.normal(size=3) * trans_m]))
    return replace(
        problem,
        map_from_body=moved,
        points_map=problem.points_map + rng.normal(size=problem.points_map.shape) * points_m,
    )


def plain_residuals(problem: BundleProblem, pose_step: Array, motion_step: Array, point_step: Array) -> Array:
    """All whitened residuals after a step (K, 6), (K, 9), (N, 3), written from the definitions with numpy alone."""
    map_from_body = np.array(
        [
            se3(so3_exp(step[:3]) @ held[:3, :3], held[:3, 3] + step[3:])
            for held, step in zip(problem.map_from_body, pose_step, strict=True)
        ]
    )
    points = problem.points_map + point_step
    parts = []
    for k, c, n, pixel, sigma in zip(*(getattr(problem, name) for name in OBSERVED), strict=True):
        cam_from_map = se3_inverse(map_from_body[k] @ problem.rig.body_from_cam[c])
        u, v, u_right = problem.rig.camera.pixel_from_point(
            (cam_from_map[:3, :3] @ points[n] + cam_from_map[:3, 3])[None]
        )[0]
        parts.append([(u - pixel[0]) / sigma[0], (v - pixel[1]) / sigma[0]])
        if np.isfinite(pixel[2]):
            parts.append([((u - u_right) - (pixel[0] - pixel[2])) / sigma[1]])
    for term in problem.relative:
        i_from_j = se3_inverse(map_from_body[term.i]) @ map_from_body[term.j]
        parts.append(np.linalg.cholesky(term.information).T @ _apart(i_from_j, term.i_from_j))
    parts += [
        np.linalg.cholesky(prior.information).T @ _apart(map_from_body[prior.k], prior.map_from_body)
        for prior in problem.priors
    ]
    if problem.inertial is not None:
        parts += _inertial_residuals(problem.inertial, map_from_body, motion_step)
    return np.concatenate([np.ravel(p) for p in parts])


def _apart(found: Array, wanted: Array) -> Array:
    """(6,) turn and shift between two transforms with the same axes."""
    return np.concatenate([so3_log(found[:3, :3] @ wanted[:3, :3].T), found[:3, 3] - wanted[:3, 3]])


def _inertial_residuals(inertial: InertialTerms, map_from_body: Array, motion_step: Array) -> list[Array]:
    velocity, gyro, accel = np.split(inertial.motions + motion_step, 3, axis=1)
    parts = []
    for i, j, summed in inertial.edges:
        delta_rot, delta_vel, delta_pos = corrected(summed, gyro[i], accel[i])
        dt, i_from_map = summed.dt_s, map_from_body[i][:3, :3].T
        residual = np.concatenate(
            [
                so3_log(delta_rot.T @ i_from_map @ map_from_body[j][:3, :3]),
                i_from_map @ (velocity[j] - velocity[i] - GRAVITY_MAP * dt) - delta_vel,
                i_from_map
                @ (map_from_body[j][:3, 3] - map_from_body[i][:3, 3] - velocity[i] * dt - 0.5 * GRAVITY_MAP * dt**2)
                - delta_pos,
                gyro[j] - gyro[i],
                accel[j] - accel[i],
            ]
        )
        parts.append(np.linalg.cholesky(np.linalg.inv(summed.cov)).T @ residual)
    for prior in inertial.priors:
        off = np.concatenate([velocity[prior.k], gyro[prior.k], accel[prior.k]]) - prior.mean
        parts.append((off / prior.sigma)[np.isfinite(prior.sigma)])
    return parts
