"""Covariances of the pose graph against gtsam's marginals, and the loop gate's two tests against known truth."""

import tracemalloc
from itertools import repeat

import gtsam
import numpy as np
import pytest

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, rotation_angle_rad, se3, se3_adjoint, se3_exp, se3_inverse
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999, ChainCovariance, GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from support.worlds.pose_graph_scene import LOOP_COV, ODOMETRY_COV, Drive, chain_of, driven, make_drive, measured


def _exact(drive: Drive, pairs: list[tuple[int, int]], is_loop: bool = True) -> list[PoseEdge]:
    """Edges without error, so that both linearisations are at the same place."""
    rng = np.random.default_rng(0)
    roots = 0.03 * rng.normal(size=(len(pairs), 6, 6))
    covs = roots @ roots.transpose(0, 2, 1) + 1e-5 * np.eye(6)
    return [
        PoseEdge(i, j, se3_inverse(drive.truth[i]) @ drive.truth[j], cov, is_loop)
        for (i, j), cov in zip(pairs, covs, strict=True)
    ]


def _gtsam_relative_cov(map_from_body: Array, edges: list[PoseEdge], i: int, j: int) -> Array:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, map_from_k in enumerate(map_from_body):
        values.insert(k, gtsam.Pose3(map_from_k))
    for edge in edges:
        j_from_i = se3_adjoint(se3_inverse(edge.i_from_j))
        noise = gtsam.noiseModel.Gaussian.Covariance(j_from_i @ edge.cov_rot_trans @ j_from_i.T, False)
        graph.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.i_from_j), noise))
    graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance([i, j])
    i_from_j = se3_adjoint(se3_inverse(map_from_body[i]) @ map_from_body[j])
    covs = [[joint.at(a, b) for b in (i, j)] for a in (i, j)]
    cross = covs[0][1] @ i_from_j.T  # gtsam perturbs on the right; d(i_from_j) = Ad(i_from_j) dj - di in the axes of i
    return np.asarray(covs[0][0] + i_from_j @ covs[1][1] @ i_from_j.T - cross - cross.T)


CHAIN = [(k, k + 1) for k in range(23)]
RINGS = [(0, 20), (3, 17), (5, 6), (17, 3), (10, 22), (1, 23)]
MANY = [
    (k, (7 * k + 5) % 24) for k in range(24) if (7 * k + 5) % 24 != k
]  # more anchors than there is room for at first
TURNED = [(k + 1, k) if k % 3 else (k, k + 1) for k in range(23)]


@pytest.mark.parametrize(
    "pairs", [CHAIN, CHAIN + RINGS, TURNED, RINGS + TURNED + MANY], ids=["chain", "rings", "turned", "all"]
)
@pytest.mark.parametrize("is_loop", [False, True])
def test_relative_covariances_are_gtsams(pairs: list[tuple[int, int]], is_loop: bool) -> None:
    drive = make_drive(np.random.default_rng(1), count=24)
    edges = _exact(drive, pairs, is_loop)
    marginals = GraphMarginals(drive.truth, edges)
    for i, j in ((0, 23), (23, 0), (4, 5), (11, 18), (20, 2)):
        wanted = _gtsam_relative_cov(drive.truth, edges, i, j)
        np.testing.assert_allclose(marginals.relative_cov(i, j), wanted, atol=1e-6 * np.abs(wanted).max(), rtol=1e-6)


def test_adding_an_edge_is_starting_with_it() -> None:
    drive = make_drive(np.random.default_rng(2), count=24)
    edges = _exact(drive, CHAIN + RINGS)
    grown, whole = GraphMarginals(drive.truth, edges[:23]), GraphMarginals(drive.truth, edges)
    for edge in edges[23:]:
        before = grown.relative_cov(2, 19)
        grown.add(edge)
        assert np.linalg.eigvalsh(before - grown.relative_cov(2, 19)).min() > -1e-12  # knowledge only grows
    everyone = np.arange(24)
    np.testing.assert_allclose(grown.relative_covs(7, everyone), whole.relative_covs(7, everyone), atol=1e-12)
    np.testing.assert_allclose(whole.relative_cov(7, 7), 0.0, atol=1e-12)
    with pytest.raises(SurveyError, match="edge 3-99"):
        grown.add(PoseEdge(3, 99, np.eye(4), LOOP_COV, True))


def test_it_does_not_matter_where_the_site_lies() -> None:
    drive = make_drive(np.random.default_rng(2), count=24)
    edges = _exact(drive, CHAIN + RINGS)
    far = drive.truth.copy()
    far[:, :3, 3] += [500_000.0, -4_000_000.0, 300.0]
    here, there = GraphMarginals(drive.truth, edges), GraphMarginals(far, edges)
    for j in range(1, 24):
        np.testing.assert_allclose(there.relative_cov(0, j), here.relative_cov(0, j), rtol=1e-5, atol=1e-8)


def test_an_edge_beside_is_the_edge_measured_from_there() -> None:
    rng = np.random.default_rng(5)
    drive = make_drive(rng, count=24)
    marginals = GraphMarginals(drive.start, drive.edges)
    edge = measured(rng, drive.truth, 20, 2, LOOP_COV, is_loop=True)
    steps = rng.normal(size=(5, 3))
    wanted = []
    for step in steps:
        map_from_j = marginals.map_from_body[2]
        i_from_map = edge.i_from_j @ se3_inverse(map_from_j) @ se3(np.eye(3), -step)
        wanted.append(marginals.innovation_squared(PoseEdge(20, 2, i_from_map @ map_from_j, LOOP_COV, True)))
    np.testing.assert_allclose(marginals.innovations_squared_beside(edge, steps), wanted, rtol=1e-9)


def test_right_loops_are_as_far_off_as_chi_square_says_and_wrong_ones_are_not() -> None:
    """Truth drawn 300 times: the squared innovation has mean 6; a place 3 m off stands out while drift is small."""
    rng = np.random.default_rng(3)
    truth = make_drive(rng, count=40, laps=1, loops=0).truth
    squared, aliased = [], []
    for _ in range(300):
        odometry = [measured(rng, truth, k, k + 1, ODOMETRY_COV, is_loop=False) for k in range(30)]
        marginals = GraphMarginals(driven([edge.i_from_j for edge in odometry], truth[0]), odometry)
        loop = measured(rng, truth, 28, 2, LOOP_COV, is_loop=True)
        squared.append(marginals.innovation_squared(loop))
        next_aisle = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 3.0, 0.0])) @ loop.i_from_j
        aliased.append(marginals.innovation_squared(PoseEdge(28, 2, next_aisle, LOOP_COV, True)))
    assert np.mean(squared) == pytest.approx(6.0, abs=0.7)  # 3 sigma of the mean is 0.6
    assert np.mean(np.array(squared) > CHI2_6_0999) < 0.015
    assert min(aliased) > CHI2_6_0999


def test_reach_grows_with_uncertainty_and_never_rules_out_the_truth() -> None:
    rng = np.random.default_rng(4)
    ruled_out = 0
    for _ in range(40):
        drive = make_drive(rng, count=60, laps=1, loops=0)
        marginals = GraphMarginals(drive.start, drive.edges)
        others = np.arange(60)
        reachable = marginals.reachable(59, others, reach_m=2.0)
        apart_m = np.linalg.norm(drive.truth[:, :3, 3] - drive.truth[59, :3, 3], axis=1)
        ruled_out += int((~reachable & (apart_m <= 2.0)).sum())
        assert not reachable[20:50].any()  # the far side of the circle
        assert reachable[59]
    assert ruled_out == 0
    surer = [PoseEdge(e.i, e.j, e.i_from_j, 1e-4 * e.cov_rot_trans, False) for e in drive.edges]
    wide, narrow = (GraphMarginals(drive.start, e).reachable(59, others, 2.0) for e in (drive.edges, surer))
    assert (narrow <= wide).all()
    assert narrow.sum() < wide.sum()


def test_memory_goes_with_the_measurements_and_an_answer_with_what_it_is_about() -> None:
    rng, sizes, asked = np.random.default_rng(1), [], np.arange(100, 120)
    for count in (200, 4000):
        steps = np.tile(1e-4 * np.eye(6), (count - 1, 1, 1))
        chain = ChainCovariance(np.concatenate([np.zeros((1, 6, 6)), np.cumsum(steps, axis=0)]))
        for _ in range(20):
            i, j = rng.choice(np.arange(1, count), 2, replace=False).tolist()
            chain.measure(i, j, 1e-4 * np.eye(6))
        tracemalloc.start()
        chain.of_differences(30, asked)
        sizes.append((chain._joint.nbytes, tracemalloc.get_traced_memory()[1]))
        tracemalloc.stop()
    assert sizes[0][0] == sizes[1][0]
    assert sizes[1][1] < 1.1 * sizes[0][1]


COUNT = 24
CHAIN_COV = np.diag([2e-3**2] * 3 + [0.02**2] * 3)
SURE_LOOP_COV = np.diag([1e-3**2] * 3 + [0.01**2] * 3)


def drifting_circle(seed: int) -> tuple[Array, Array, list[PoseEdge]]:
    """Truth (K, 4, 4) of one round, the same by odometry with noise, and the odometry's edges."""
    rng = np.random.default_rng(seed)
    step, start = (
        se3_exp(np.array(at)) for at in ([0, 0, 2 * np.pi / COUNT, 0.5, 0, 0], [0.1, 0.2, 0.5, 40.0, -30.0, 2.0])
    )
    found = driven([se3_exp(rng.normal(0, np.sqrt(np.diag(CHAIN_COV)))) @ step for _ in range(COUNT)], start)
    return driven([step] * COUNT, start), found, chain_of(found, repeat(CHAIN_COV))


def loop(true: Array, i: int, j: int) -> PoseEdge:
    return PoseEdge(i, j, se3_inverse(true[i]) @ true[j], SURE_LOOP_COV, is_loop=True)


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
