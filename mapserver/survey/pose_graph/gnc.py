"""Graduated non-convexity (GNC): outlying loops of a pose graph whose other edges are true. Source: Yang et al. 2020.

Own code, because `gtsam.GncLMOptimizer`, known inliers and bound the same, solves to the end at each of its steps: of parking-garage
(1,661 poses, one wrong loop more for 20) it had no result in 57 CPU s, where `loop_weights` ends after 13.4. Drives of 80 poses
(tests/mapserver/survey/pose_graph/test_pose_graph.py) take both of them 0.14 s and end at the same cost.
"""

import gtsam
import numpy as np

from fleetmap.geometry import Array

_GROWTH = 1.6  # of the control parameter, from almost convex to truncated
_STEPS = 2  # Levenberg-Marquardt iterations between two updates of the weights
_MAX_UPDATES = 150
_UNSURE = 1e-3  # a weight so near to 0 or 1 counts as decided


def loop_weights(
    certain: gtsam.NonlinearFactorGraph,
    loops: list[gtsam.NoiseModelFactor],
    start: gtsam.Values,
    bound: float,
) -> tuple[Array, gtsam.Values]:
    """Weight (len(loops),) of each loop, 1 believed and 0 not, and where the keyframes are then.

    `certain`: all that is taken for true. A loop is consistent while its squared residual stays within `bound`. Each step makes the cost a
    little less convex and takes up where the last one ended, so that the whole costs little more than one solve. It begins once near
    `start`, where at least the better half of the loops pulls, and, should that end in disbelief, once more with every loop pulling; the
    lower truncated cost wins. Source: Yang et al. 2020, Graduated non-convexity for robust spatial perception.
    """
    squared = squared_residuals(loops, start)
    if (squared <= bound).all():
        return np.ones(len(loops)), start
    reaches = (4.0 * float(np.median(squared)), 2.0 * float(squared.max()))
    found: list[tuple[float, Array, gtsam.Values]] = []
    for reach in reaches:
        found.append(_anneal(certain, loops, start, bound, min(bound / max(reach - bound, bound), 1.0)))
        if found[-1][1].min() > 0.5:
            break
    _, weights, values = min(found, key=lambda one: one[0])
    return weights, values


def _anneal(
    certain: gtsam.NonlinearFactorGraph,
    loops: list[gtsam.NoiseModelFactor],
    start: gtsam.Values,
    bound: float,
    control: float,
) -> tuple[float, Array, gtsam.Values]:
    """Truncated cost, weights and places, annealed from a control parameter."""
    values = start
    for _ in range(_MAX_UPDATES):
        weights = truncated_weights(squared_residuals(loops, values), bound, control)
        values = improved(certain, loops, weights, values, _STEPS)
        if (np.minimum(weights, 1.0 - weights) < _UNSURE).all() and control > 1.0:
            break
        control *= _GROWTH
    cost = certain.error(values) + 0.5 * float(np.minimum(squared_residuals(loops, values), bound).sum())
    return cost, weights, values


def truncated_weights(squared: Array, bound: float, control: float) -> Array:
    """Weights of squared residuals under the surrogate of truncated least squares. Source: Yang et al. 2020, eq. 14."""
    between = np.sqrt(bound * control * (control + 1.0) / np.maximum(squared, 1e-12)) - control
    weights = np.where(squared >= bound * (control + 1.0) / control, 0.0, between)
    return np.asarray(np.where(squared <= bound * control / (control + 1.0), 1.0, np.clip(weights, 0.0, 1.0)))


def squared_residuals(loops: list[gtsam.NoiseModelFactor], values: gtsam.Values) -> Array:
    """(len(loops),) squared residuals in sigmas."""
    return 2.0 * np.array([loop.error(values) for loop in loops])


def improved(
    certain: gtsam.NonlinearFactorGraph,
    loops: list[gtsam.NoiseModelFactor],
    weights: Array,
    values: gtsam.Values,
    steps: int,
) -> gtsam.Values:
    """The values after so many steps of Levenberg-Marquardt in which each loop has its weight."""
    graph = gtsam.NonlinearFactorGraph(certain)
    for loop, weight in zip(loops, weights, strict=True):
        if weight >= 1.0 - _UNSURE:
            graph.push_back(loop)
        elif weight > 0.0:  # however little: a sure loop far off begins with the bound's share of its square
            noise = loop.noiseModel()
            assert isinstance(noise, gtsam.noiseModel.Gaussian)
            weaker = gtsam.noiseModel.Gaussian.SqrtInformation(noise.R() * np.sqrt(weight))
            graph.push_back(loop.cloneWithNewNoiseModel(weaker))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    settings.setMaxIterations(steps)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
