"""Bundle adjustment: keyframes, landmarks, motion and biases with the best fit to all observations.

The core solves (shared/core/bundle.h); this module checks a problem and passes it as arrays. Source: Triggs et al. 2000, Bundle
adjustment, a modern synthesis; inertial terms after Forster et al. 2017.
"""

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.errors import SurveyError
from fleetmap.geometry import Array
from fleetmap.inertial import GRAVITY_MAP
from mapserver.survey.bundle.elimination_order import minimum_degree
from mapserver.survey.bundle.factors import pack_terms
from mapserver.survey.bundle.problem import BundleProblem, BundleResult
from mapserver.survey.settings import BundleSettings


def optimize(problem: BundleProblem, settings: BundleSettings) -> BundleResult:
    """Return the optimum near the problem's values; `problem` is unchanged.

    Raises SurveyError if no keyframe, prior or gauge fixes the map, and for values that are not finite. Inertial edges follow
    bias changes to first order; if those are large, preintegrate again at the result's biases and optimise once more.
    """
    solver = solver_of(problem, settings)
    cost = solver.cost()
    if not (np.isfinite(cost) and np.isfinite(solver.squared_sigmas()).all()):
        raise SurveyError(f"bundle adjustment starts with cost {cost}; {_first_bad(problem, solver.squared_sigmas())}")
    costs, iterations, converged = solver.optimize(
        settings.lambda_start, settings.max_iterations, settings.relative_cost_tolerance
    )
    motions, inertial = solver.motions(), problem.inertial is not None
    return BundleResult(
        map_from_body=solver.map_from_body(),
        points_map=solver.points_map(),
        velocities_map_mps=motions[:, :3].copy() if inertial else None,
        gyro_bias_radps=motions[:, 3:6].copy() if inertial else None,
        accel_bias_mps2=motions[:, 6:9].copy() if inertial else None,
        costs=costs.tolist(),
        squared_sigmas=solver.squared_sigmas(),
        iterations=iterations,
        converged=converged,
    )


def solver_of(problem: BundleProblem, settings: BundleSettings) -> core.BundleSolver:
    """Return the core's solver at the values of `problem`; SurveyError if nothing fixes the map."""
    _check(problem)
    solver = core.BundleSolver(
        problem.rig.camera.lens,
        np.ascontiguousarray(problem.rig.body_from_cam, np.float64),
        np.ascontiguousarray(problem.map_from_body, np.float64),
        _motions(problem),
        np.ascontiguousarray(problem.points_map, np.float64).reshape(-1, 3),
        _free_unknowns(problem),
        problem.points_held,
        np.ascontiguousarray(problem.obs_keyframe, np.int32),
        np.ascontiguousarray(problem.obs_camera, np.int32),
        np.ascontiguousarray(problem.obs_landmark, np.int32),
        np.ascontiguousarray(problem.obs_pixels, np.float64),
        np.ascontiguousarray(problem.obs_sigma_px, np.float64),
        *pack_terms(problem),
        GRAVITY_MAP,
        settings.huber_sigmas,
        settings.cutoff_sigmas,
        problem.calibration,
    )
    if solver.unknowns > settings.dense_unknowns:
        sizes, pairs = solver.nodes()
        solver.factorise_sparsely(minimum_degree(len(sizes), pairs))
    return solver


def _motions(problem: BundleProblem) -> Array:
    """Return (K, 9) velocity, gyro bias, accelerometer bias; (K, 0) without inertial terms."""
    inertial = problem.inertial
    if inertial is None:
        return np.zeros((len(problem.map_from_body), 0))
    parts = inertial.velocities_map_mps, inertial.gyro_bias_radps, inertial.accel_bias_mps2
    return np.concatenate(parts, axis=1, dtype=np.float64)


def _first_bad(problem: BundleProblem, squared: Array) -> str:
    """Return the observation that is not finite, as text."""
    bad = np.nonzero(~np.isfinite(squared))[0]
    if len(bad) == 0:
        return "a prior, relative or inertial term is not finite, check its values and covariance"
    n = int(bad[0])
    landmark = problem.obs_landmark[n]
    return (
        f"observation {n} of {len(squared)}: pixels {problem.obs_pixels[n]}, sigma {problem.obs_sigma_px[n]}, "
        f"landmark {landmark} at {problem.points_map[landmark]}; leave it out"
    )


def _check(problem: BundleProblem) -> None:
    if problem.gauge == "yaw_position" and (problem.inertial is None or not problem.inertial.edges):
        raise SurveyError('gauge "yaw_position" needs inertial edges, there are none; fix a keyframe, use gauge "pose"')
    if problem.gauge == "pose" and not problem.fixed.any() and not problem.priors:
        raise SurveyError(
            f"bundle adjustment of {len(problem.map_from_body)} keyframes has none fixed and no prior: fix one, "
            'or use gauge "yaw_position" with inertial terms'
        )


def _free_unknowns(problem: BundleProblem) -> NDArray[np.bool_]:
    """Return (K, 6 or 15): rotation, translation, velocity, gyro bias, accelerometer bias."""
    count, inertial = len(problem.map_from_body), problem.inertial
    moves = np.zeros((count, 6 if inertial is None else 15), np.bool_)
    if problem.gauge == "pose":
        moves[:, :6] = ~problem.fixed[:, None]
    else:
        held = problem.fixed.copy()
        held[0] |= not held.any()
        moves[:, :2] = True
        moves[:, 2:6] = ~held[:, None]
    if inertial is not None:
        for i, j, _ in inertial.edges:
            moves[[i, j], 6:] = True
        if inertial.fixed is not None:
            moves[inertial.fixed, 6:] = False
    return moves
