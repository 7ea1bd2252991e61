"""Graduated non-convexity (GNC): finds outlier loops of a pose graph whose other edges are true. Source: Yang et al. 2020.

Own code, because `gtsam.GncLMOptimizer`, with the same known inliers and bound, solves to convergence at each step: of parking-garage
(1,661 poses, one wrong loop more for 20) it had no result in 57 CPU s, where `loop_weights` ends after 13.4. Drives of 80 poses
(tests/mapserver/survey/pose_graph/test_pose_graph.py) take both of them 0.14 s and end at the same cost.
"""

import gtsam
import numpy as np

from fleetmap.geometry import Array

_GROWTH = 1.6  # of the control parameter, from almost convex to truncated
_STEPS = 2  # Levenberg-Marquardt iterations between two updates of the weights
_MAX_UPDATES = 150
_UNSURE = 1e-3  # a weight this near to 0 or 1 counts as decided


def loop_weights(
    certain: gtsam.NonlinearFactorGraph,
    loops: list[gtsam.NoiseModelFactor],
    start: gtsam.Values,
    bound: float,
) -> tuple[Array, gtsam.Values]:
    """Return the weight (len(loops),) of each loop, 1 accepted and 0 not, and the resulting poses of the keyframes.

    `certain`: all edges assumed true. A loop is consistent while its squared residual stays within `bound`. Each step makes the cost a
    little less convex and continues from the last result, so the whole costs little more than one solve. It starts near
    `start`, with weights that keep the better half of the loops active, and, if loops are rejected, again with all loops active; the
    lower truncated cost is returned. Source: Yang et al. 2020, Graduated non-convexity for robust spatial perception.
    """
    squared = squared_residuals(loops, start)
    if (squared <= bound).all():
        return np.ones(len(loops)), start
    found: list[tuple[float, Array, gtsam.Values]] = []
    for reach in (4.0 * float(np.median(squared)), 2.0 * float(squared.max())):
        control, values = min(bound / max(reach - bound, bound), 1.0), start
        for _ in range(_MAX_UPDATES):
            weights = truncated_weights(squared_residuals(loops, values), bound, control)
            values = improved(certain, loops, weights, values, _STEPS)
            if (np.minimum(weights, 1.0 - weights) < _UNSURE).all() and control > 1.0:
                break
            control *= _GROWTH
        cost = certain.error(values) + 0.5 * float(np.minimum(squared_residuals(loops, values), bound).sum())
        found.append((cost, weights, values))
        if weights.min() > 0.5:
            break
    return min(found, key=lambda one: one[0])[1:]


def truncated_weights(squared: Array, bound: float, control: float) -> Array:
    """Return weights of squared residuals under the surrogate of truncated least squares. Source: Yang et al. 2020, eq. 14."""
    between = np.sqrt(bound * control * (control + 1.0) / np.maximum(squared, 1e-12)) - control
    weights = np.where(squared >= bound * (control + 1.0) / control, 0.0, between)
    return np.asarray(np.where(squared <= bound * control / (control + 1.0), 1.0, np.clip(weights, 0.0, 1.0)))


def squared_residuals(loops: list[gtsam.NoiseModelFactor], values: gtsam.Values) -> Array:
    """Return (len(loops),) squared residuals in sigmas."""
    return 2.0 * np.array([loop.error(values) for loop in loops])


def improved(
    certain: gtsam.NonlinearFactorGraph,
    loops: list[gtsam.NoiseModelFactor],
    weights: Array,
    values: gtsam.Values,
    steps: int,
) -> gtsam.Values:
    """Return the values after some steps of Levenberg-Marquardt with weighted loops."""
    graph = gtsam.NonlinearFactorGraph(certain)
    for loop, weight in zip(loops, weights, strict=True):
        if weight >= 1.0 - _UNSURE:
            graph.push_back(loop)
        elif weight > 0.0:  # however small: a distant true loop starts with the bound's share of its square
            noise = loop.noiseModel()
            assert isinstance(noise, gtsam.noiseModel.Gaussian)
            weaker = gtsam.noiseModel.Gaussian.SqrtInformation(noise.R() * np.sqrt(weight))
            graph.push_back(loop.cloneWithNewNoiseModel(weaker))
    return descended(graph, values, steps)[0]


def descended(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, steps: int) -> tuple[gtsam.Values, int]:
    """Return the values after at most `steps` of Levenberg-Marquardt, and their number."""
    settings = gtsam.LevenbergMarquardtParams()
    settings.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    settings.setMaxIterations(steps)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, settings)
    return optimizer.optimize(), int(optimizer.iterations())
