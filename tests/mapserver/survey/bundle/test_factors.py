"""Visual-inertial bundle adjustment: truth from sparse frames, gravity decides the attitude, gtsam agrees."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from fleetmap.geometry import se3, so3_exp
from fleetmap.inertial import preintegrate
from fleetmap.sensors.samples import ImuSamples
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.problem import BundleProblem, continued
from mapserver.survey.settings import BundleSettings
from mapserver.survey.state import turned
from support.worlds.bundle_gtsam import gtsam_graph
from support.worlds.bundle_scene import ACCEL_BIAS, GYRO_BIAS, NOISE, Scene, disturbed, make_scene
from support.worlds.inertial_motion import sample_motion

PATIENT = BundleSettings(max_iterations=60, relative_cost_tolerance=1e-12)


def _unknowing(scene: Scene, *, seed: int) -> BundleProblem:
    """0.3 m and 2 degrees off, velocities off, biases unknown and preintegrated as zero."""
    problem = disturbed(scene.problem, seed=seed, rot_rad=0.02, trans_m=0.17, points_m=0.2)
    velocities = scene.velocities_map_mps
    velocities = velocities + np.random.default_rng(seed).normal(size=velocities.shape) * 0.3
    inertial = replace(problem.inertial, motions=np.pad(velocities, ((0, 0), (0, 6))))
    edges = [
        (i, j, preintegrate(_imu(scene), e.start_ns, e.end_ns, np.zeros(3), np.zeros(3), NOISE))
        for i, j, e in problem.inertial.edges
    ]
    return replace(problem, inertial=replace(inertial, edges=edges))


def _imu(scene: Scene) -> ImuSamples:
    return sample_motion(
        rate_hz=200.0, duration_s=float(scene.times_s[-1]) + 0.1, gyro_bias=GYRO_BIAS, accel_bias=ACCEL_BIAS
    )


@pytest.mark.parametrize(("step_s", "dense_unknowns"), [(2.0, 1500), (2.0, 0), (6.0, 1500)])
def test_sparse_frames_converge_to_the_truth(step_s: float, dense_unknowns: int) -> None:
    scene = make_scene(keyframes=12, landmarks=300, step_s=step_s, seed=21, inertial=True)
    problem = _unknowing(scene, seed=22)
    settings = BundleSettings(max_iterations=40, relative_cost_tolerance=1e-8, dense_unknowns=dense_unknowns)
    for _ in range(3):
        result = optimize(problem, settings)
        problem = continued(problem, result)
        inertial = problem.inertial
        inertial.edges = [
            (i, j, preintegrate(_imu(scene), e.start_ns, e.end_ns, *np.split(inertial.motions[i, 3:], 2), NOISE))
            for i, j, e in inertial.edges
        ]
    np.testing.assert_allclose(result.map_from_body, scene.problem.map_from_body, atol=2e-3)
    np.testing.assert_allclose(result.motions[:, 3:6], np.tile(GYRO_BIAS, (12, 1)), atol=2e-4)
    np.testing.assert_allclose(result.motions[:, 6:], np.tile(ACCEL_BIAS, (12, 1)), atol=2e-2)
    np.testing.assert_allclose(result.motions[:, :3], scene.velocities_map_mps, atol=1e-2)


def test_gravity_decides_roll_and_pitch() -> None:
    scene = make_scene(keyframes=10, landmarks=200, step_s=0.5, seed=31, inertial=True)
    tilt = so3_exp(np.array([0.05, -0.03, 0.0]))
    origin = scene.problem.map_from_body[0, :3, 3]
    tilted_from_map = se3(tilt, origin - tilt @ origin)
    problem = scene.problem
    tilted = replace(
        problem,
        gauge="yaw_position",
        map_from_body=tilted_from_map @ problem.map_from_body,
        points_map=problem.points_map @ tilted_from_map[:3, :3].T + tilted_from_map[:3, 3],
        inertial=replace(problem.inertial, motions=turned(problem.inertial.motions, np.tile(tilt, (10, 1, 1)))),
    )
    result = optimize(tilted, PATIENT)
    # compare without yaw: up, as each keyframe sees it
    np.testing.assert_allclose(result.map_from_body[:, 2, :3], problem.map_from_body[:, 2, :3], atol=1e-4)
    np.testing.assert_allclose(result.map_from_body[0, :3, 3], origin)
    assert optimize(replace(tilted, gauge="pose"), PATIENT).costs[-1] > 10 * result.costs[-1] + 1.0


def test_held_motion_stays() -> None:
    scene = make_scene(keyframes=6, landmarks=150, step_s=0.5, seed=33, noise_px=1.0, inertial=True)
    problem = disturbed(scene.problem, seed=5, rot_rad=0.01, trans_m=0.05, points_m=0.05)
    held = np.array([True, False, False, False, False, False])
    result = optimize(replace(problem, inertial=replace(problem.inertial, fixed=held)), PATIENT)
    is_unchanged = result.motions[:, :3] == scene.velocities_map_mps
    assert is_unchanged[0].all() and not is_unchanged[1:].any()


def test_same_optimum_as_gtsam() -> None:
    scene = make_scene(keyframes=6, landmarks=120, step_s=0.5, seed=35, noise_px=1.0, inertial=True)
    problem = disturbed(scene.problem, seed=36, rot_rad=0.01, trans_m=0.05, points_m=0.05)
    unrobust = BundleSettings(max_iterations=100, relative_cost_tolerance=1e-12, huber_sigmas=1e6)
    ours = optimize(problem, unrobust)
    graph, values = gtsam_graph(problem, 1e6)
    imu = _imu(scene)
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    params.setGyroscopeCovariance(NOISE.gyro_noise_radps_rthz**2 * np.eye(3))
    params.setAccelerometerCovariance(NOISE.accel_noise_mps2_rthz**2 * np.eye(3))
    params.setIntegrationCovariance(1e-18 * np.eye(3))
    params.setBiasAccCovariance(NOISE.accel_walk_mps3_rthz**2 * np.eye(3))
    params.setBiasOmegaCovariance(NOISE.gyro_walk_radps2_rthz**2 * np.eye(3))
    for k in range(6):
        values.insert(gtsam.symbol("v", k), scene.velocities_map_mps[k])
        values.insert(gtsam.symbol("b", k), gtsam.imuBias.ConstantBias(ACCEL_BIAS, GYRO_BIAS))
    for i, j, summed in problem.inertial.edges:
        theirs = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(ACCEL_BIAS, GYRO_BIAS))
        steps = 4000
        dt_s = summed.dt_s / steps
        middles = summed.start_ns * 1e-9 + (np.arange(steps) + 0.5) * dt_s
        gyro = np.stack([np.interp(middles, imu.stamps_ns * 1e-9, c) for c in imu.gyro_radps.T], axis=1)
        accel = np.stack([np.interp(middles, imu.stamps_ns * 1e-9, c) for c in imu.accel_mps2.T], axis=1)
        for w, a in zip(gyro, accel, strict=True):
            theirs.integrateMeasurement(a, w, dt_s)
        keys = [gtsam.symbol(letter, k) for letter, k in (("x", i), ("v", i), ("x", j), ("v", j), ("b", i), ("b", j))]
        graph.add(gtsam.CombinedImuFactor(*keys, theirs))
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert ours.costs[-1] == pytest.approx(graph.error(optimum), rel=2e-3)
    for k in range(6):
        np.testing.assert_allclose(ours.map_from_body[k], optimum.atPose3(gtsam.symbol("x", k)).matrix(), atol=5e-4)
