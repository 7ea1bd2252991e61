"""Bundle adjustment: keyframes, landmarks, motion and biases with the best fit to all observations.

The core solves (shared/core/bundle.h); this module checks a problem and passes it as arrays. Source: Triggs et al. 2000, Bundle
adjustment, a modern synthesis; inertial terms after Forster et al. 2017.
"""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import scipy

from fleetmap import core
from fleetmap.errors import SurveyError
from fleetmap.geometry import AnyArray, Array, Mask
from fleetmap.inertial import GRAVITY_MAP, Preintegrated
from mapserver.survey.bundle.problem import BundleProblem, BundleResult
from mapserver.survey.settings import BundleSettings

# Lower bound of an increment's covariance: below is rounding error, and the bound keeps empty intervals invertible.
FLOOR_SIGMA = np.repeat([1e-7, 1e-6, 1e-7, 1e-9, 1e-8], 3)

# Parts of an increment for the core, in its order, which is that of the record's fields
_INCREMENTS = [f.name for f in fields(Preintegrated) if f.name not in {"start_ns", "end_ns", "cov", "max_gap_s"}]


def optimize(problem: BundleProblem, settings: BundleSettings) -> BundleResult:
    """Return the optimum near the problem's values; `problem` is unchanged.

    Raises SurveyError if no keyframe, prior or gauge fixes the map, and for values that are not finite. Inertial edges follow
    bias changes to first order; if those are large, preintegrate again at the result's biases and optimise once more.
    """
    solver = solver_of(problem, settings)
    cost = solver.cost()
    if not (np.isfinite(cost) and np.isfinite(solver.squared_sigmas()).all()):
        raise SurveyError(f"bundle adjustment starts with cost {cost}; {_first_bad(problem, solver.squared_sigmas())}")
    costs, *_ = solver.optimize(settings.lambda_start, settings.max_iterations, settings.relative_cost_tolerance)
    return BundleResult(
        map_from_body=solver.map_from_body(),
        points_map=solver.points_map(),
        motions=None if problem.inertial is None else solver.motions(),
        costs=costs.tolist(),
        squared_sigmas=solver.squared_sigmas(),
    )


def solver_of(problem: BundleProblem, settings: BundleSettings) -> core.BundleSolver:
    """Return the core's solver at the values of `problem`; SurveyError if nothing fixes the map."""
    _check(problem)
    count, inertial, relative, priors = len(problem.map_from_body), problem.inertial, problem.relative, problem.priors
    motions, edges = (np.zeros((count, 0)), []) if inertial is None else (inertial.motions, inertial.edges)
    summed = [increment for _, _, increment in edges]
    mean, weight = np.zeros(motions.shape), np.zeros(motions.shape)
    for prior in [] if inertial is None else inertial.priors:
        mean[prior.k] = np.where(np.isfinite(prior.sigma), prior.mean, 0.0)
        weight[prior.k] = 1.0 / prior.sigma**2
    solver = core.BundleSolver(
        problem.rig.camera.lens,
        np.ascontiguousarray(problem.rig.body_from_cam, np.float64),
        np.ascontiguousarray(problem.map_from_body, np.float64),
        np.ascontiguousarray(motions, np.float64),
        np.ascontiguousarray(problem.points_map, np.float64).reshape(-1, 3),
        _free_unknowns(problem),
        problem.points_held,
        np.ascontiguousarray(problem.obs_keyframe, np.int32),
        np.ascontiguousarray(problem.obs_camera, np.int32),
        np.ascontiguousarray(problem.obs_landmark, np.int32),
        np.ascontiguousarray(problem.obs_pixels, np.float64),
        np.ascontiguousarray(problem.obs_sigma_px, np.float64),
        np.array([(term.i, term.j) for term in relative], np.int64).reshape(-1, 2),
        _stacked([term.i_from_j for term in relative], 4),
        _stacked([term.information for term in relative], 6),
        np.array([term.k for term in priors], np.int64),
        _stacked([term.map_from_body for term in priors], 4),
        _stacked([term.information for term in priors], 6),
        np.array([(i, j) for i, j, _ in edges], np.int64).reshape(-1, 2),
        packed_increments(summed),
        _informations(_stacked([increment.cov for increment in summed], 15)),
        mean,
        weight,
        GRAVITY_MAP,
        settings.huber_sigmas,
        settings.cutoff_sigmas,
        problem.calibration,
    )
    if solver.unknowns > settings.dense_unknowns:
        sizes, pairs = solver.nodes()
        solver.factorise_sparsely(minimum_degree(len(sizes), pairs))
    return solver


def _stacked(matrices: Sequence[Array], size: int) -> Array:
    """Return matrices (n, size, size), of which there may be none."""
    return np.array(matrices, np.float64).reshape(-1, size, size)


def packed_increments(summed: Sequence[Preintegrated]) -> Array:
    """Return (E, 67): dt, dR, dv, dp, the five derivatives by the biases, and the biases of linearisation."""
    fields = (np.array([getattr(each, name) for each in summed]) for name in _INCREMENTS)
    return np.hstack([field.reshape(len(summed), -1) for field in fields]) if summed else np.zeros((0, 67))


def _informations(covariances: Array) -> Array:
    """Return inverse covariances (E, 15, 15), scaled first: rotation and velocity differ by many orders of magnitude."""
    sigma = np.sqrt(np.einsum("eaa->ea", covariances) + FLOOR_SIGMA**2)
    outer = sigma[:, :, None] * sigma[:, None, :]
    inverse = np.linalg.inv((covariances + np.diag(FLOOR_SIGMA**2)) / outer)
    return np.asarray(0.5 * (inverse + inverse.transpose(0, 2, 1)) / outer)


def minimum_degree(count: int, pairs: AnyArray) -> AnyArray:
    """Return (N,) an elimination order of nodes with little fill-in; `pairs` (B, 2) are coupled nodes.

    SuperLU computes the minimum degree order from a matrix with one unknown per node, at negligible cost.
    """
    nodes, pairs = np.arange(count), pairs[pairs[:, 0] != pairs[:, 1]]
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    # Laplacian plus identity: positive definite for any pairs.
    rows, cols = np.concatenate([nodes, ends[:, 0], ends[:, 0]]), np.concatenate([nodes, ends[:, 0], ends[:, 1]])
    values = np.concatenate([np.ones(count + len(ends)), np.full(len(ends), -1.0)])
    graph = scipy.sparse.csc_array((values, (rows, cols)), shape=(count, count))
    options = {"SymmetricMode": True}
    factor = scipy.sparse.linalg.splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c)


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


def _free_unknowns(problem: BundleProblem) -> Mask:
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
