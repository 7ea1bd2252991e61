"""An accepted loop moves what the gate predicts, not only how sure it is: against gtsam's optimum of the same graph."""

import numpy as np
import pytest

from fleetmap.geometry import Array, rotation_angle_rad, se3_exp, se3_inverse
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999, GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph

COUNT = 24
CHAIN_COV = np.diag([2e-3**2] * 3 + [0.02**2] * 3)
LOOP_COV = np.diag([1e-3**2] * 3 + [0.01**2] * 3)


def drifting_circle(seed: int) -> tuple[Array, Array, list[PoseEdge]]:
    """Truth (K, 4, 4) of one round, the same by odometry with noise, and the odometry's edges."""
    rng = np.random.default_rng(seed)
    step = se3_exp(np.array([0, 0, 2 * np.pi / COUNT, 0.5, 0, 0]))
    true = [se3_exp(np.array([0.1, 0.2, 0.5, 40.0, -30.0, 2.0]))]
    measured = [true[0]]
    edges = []
    for k in range(COUNT):
        noisy = se3_exp(rng.normal(0, np.sqrt(np.diag(CHAIN_COV)))) @ step
        edges.append(PoseEdge(k, k + 1, noisy, CHAIN_COV, is_loop=False))
        true.append(true[-1] @ step)
        measured.append(measured[-1] @ noisy)
    return np.array(true), np.array(measured), edges


def loop(true: Array, i: int, j: int) -> PoseEdge:
    return PoseEdge(i, j, se3_inverse(true[i]) @ true[j], LOOP_COV, is_loop=True)


@pytest.mark.parametrize("seed", range(4))
def test_loops_move_the_graph_to_the_optimum(seed: int) -> None:
    true, measured, chain = drifting_circle(seed)
    marginals = GraphMarginals(measured, chain)
    np.testing.assert_allclose(marginals.map_from_body, measured, atol=1e-12)
    loops = [loop(true, COUNT, 0), loop(true, COUNT - 1, 1)]
    for edge in loops:
        marginals.add(edge)
    best = optimize_pose_graph(measured, [*chain, *loops], robust=False).map_from_body
    found = marginals.map_from_body
    found = best[0] @ se3_inverse(found[0]) @ found  # the marginals hold no keyframe fixed
    correction_m = np.linalg.norm(best[:, :3, 3] - measured[:, :3, 3], axis=1).max()
    assert correction_m > 0.05
    assert np.linalg.norm(found[:, :3, 3] - best[:, :3, 3], axis=1).max() < 0.03 * correction_m
    assert max(rotation_angle_rad(a[:3, :3].T @ b[:3, :3]) for a, b in zip(found, best, strict=True)) < 3e-4


def test_after_a_loop_the_gate_is_around_the_true_place() -> None:
    """Drift of several chain sigmas: the neighbouring true loop passes, one to where odometry was does not."""
    true, measured, chain = drifting_circle(1)
    pushed = se3_exp(np.array([0, 0, 0, 0.25, 0.15, 0.0]))  # two sigmas and more of the whole way
    measured = np.array([*measured[:-2], measured[-2] @ pushed, measured[-1] @ pushed])
    chain[-2] = PoseEdge(
        COUNT - 2, COUNT - 1, se3_inverse(measured[-3]) @ measured[-2], np.diag([4e-6] * 3 + [0.01] * 3), is_loop=False
    )
    chain[-1] = PoseEdge(COUNT - 1, COUNT, se3_inverse(measured[-2]) @ measured[-1], CHAIN_COV, is_loop=False)
    marginals = GraphMarginals(measured, chain)
    first = loop(true, COUNT, 0)
    assert marginals.innovation_squared(first) < CHI2_6_0999
    marginals.add(first)
    assert marginals.innovation_squared(loop(true, COUNT - 1, 1)) < CHI2_6_0999
    assert marginals.innovation_squared(loop(measured, COUNT - 1, 1)) > CHI2_6_0999
