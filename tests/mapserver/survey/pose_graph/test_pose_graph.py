"""Pose graphs: benchmark problems against gtsam's own reader and solver, sure and wrong loops, a corridor's doppelganger, bad input."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, se3, se3_exp, so3_exp
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from studies import doppelganger
from support.problems.g2o import parse_g2o
from support.recordings.realdata import real_data
from support.worlds.pose_graph_scene import Drive, driven, make_drive


def _revisit_error_m(drive: Drive, map_from_body: Array) -> float:
    """Root mean square error of where a keyframe is seen from the same place of the lap before, over all of them."""
    seen, true = (
        np.array([np.linalg.inv(frame_from_body[k - 40]) @ frame_from_body[k] for k in range(40, 80)])[:, :3, 3]
        for frame_from_body in (map_from_body, drive.truth)
    )
    return float(np.sqrt(np.mean(np.sum((seen - true) ** 2, axis=1))))


@pytest.mark.parametrize("name", ["sphere2500", "parking-garage"])
def test_benchmark_problems_end_where_gtsam_ends(name: str) -> None:
    file = real_data("pose_graphs") / f"{name}.g2o"
    map_from_body, edges = parse_g2o(file.read_text())
    graph, values = gtsam.readG2o(str(file), True)
    graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    optimum = gtsam.GaussNewtonOptimizer(graph, values).optimize()
    result = optimize_pose_graph(map_from_body, edges, robust=False)
    assert result.cost == pytest.approx(graph.error(optimum), rel=1e-4)
    theirs = np.array([optimum.atPose3(k).matrix() for k in range(len(map_from_body))])
    np.testing.assert_allclose(result.map_from_body[:, :3, 3], theirs[:, :3, 3], atol=0.02)
    np.testing.assert_array_equal(result.map_from_body[0], map_from_body[0])


@pytest.mark.parametrize("seed", range(3))
def test_loops_straighten_the_drive_and_wrong_ones_are_disbelieved(seed: int) -> None:
    drive = make_drive(np.random.default_rng(seed), loops=15, wrong=5)
    result = optimize_pose_graph(drive.start, drive.edges)
    np.testing.assert_array_equal(result.loop_weights < 0.5, drive.wrong)
    clean = [edge for edge, bad in zip(drive.edges, [*[False] * 79, *drive.wrong], strict=True) if not bad]
    alone = optimize_pose_graph(drive.start, clean, robust=False)
    np.testing.assert_allclose(result.map_from_body, alone.map_from_body, atol=1e-4)
    assert result.cost == pytest.approx(alone.cost, rel=1e-4)
    error_m = _revisit_error_m(drive, result.map_from_body)
    assert error_m < 0.35 * _revisit_error_m(drive, drive.start)
    deceived = optimize_pose_graph(drive.start, drive.edges, robust=False)
    assert _revisit_error_m(drive, deceived.map_from_body) > 5 * error_m


def test_without_loops_nothing_moves() -> None:
    drive = make_drive(np.random.default_rng(5), loops=0)
    result = optimize_pose_graph(drive.start, drive.edges)
    assert len(result.loop_weights) == 0
    np.testing.assert_allclose(result.map_from_body, drive.start, atol=1e-9)


def test_covariances_are_of_the_axes_of_i() -> None:
    """Two edges disagree about where j is along the y axis of i; the surer one wins, by the ratio of variances."""
    i_from_j = se3_exp(np.array([0.0, 0.0, 1.2, 4.0, 1.0, 0.0]))
    loose_in_y = np.diag([1e-8] * 3 + [1e-8, 1e-2, 1e-8])
    shifted = i_from_j.copy()
    shifted[1, 3] += 0.3
    edges = [PoseEdge(0, 1, i_from_j, loose_in_y, False), PoseEdge(0, 1, shifted, 0.5 * loose_in_y, False)]
    result = optimize_pose_graph(np.array([np.eye(4), i_from_j]), edges)
    np.testing.assert_allclose(result.map_from_body[1][:3, 3] - i_from_j[:3, 3], [0.0, 0.2, 0.0], atol=1e-3)


def test_bad_graphs_are_refused_with_their_edge() -> None:
    drive = make_drive(np.random.default_rng(8), loops=2)
    edge = drive.edges[5]
    nan = np.full((4, 4), np.nan)
    for spoiled, words in (
        (replace(edge, j=200), "edge 5-200"),
        (replace(edge, j=5), "edge 5-5"),
        (replace(edge, i_from_j=nan), "edge 5-6"),
        (replace(edge, cov_rot_trans=np.zeros((6, 6))), "edge 5-6"),
        (replace(edge, cov_rot_trans=np.diag([np.inf] * 6)), "edge 5-6"),
    ):
        with pytest.raises(SurveyError, match=words):
            optimize_pose_graph(drive.start, [*drive.edges[:5], spoiled, *drive.edges[6:]])
    with pytest.raises(SurveyError, match=r"keyframes \[41, 42"):
        optimize_pose_graph(drive.start, drive.edges[:40])


def _square(turn_deg: float) -> list[Array]:
    """Steps of a metre, ten to a leg, and after each of the four legs a turn on the spot."""
    turn = se3(so3_exp(np.array([0.0, 0.0, np.radians(turn_deg)])), np.zeros(3))
    return ([se3(np.eye(3), np.array([1.0, 0.0, 0.0]))] * 10 + [turn]) * 4


def _closed(turn_sigma_deg: float, loop_sigma_deg: float) -> tuple[bool, float]:
    """Whether the loop is believed that closes a square whose turns are two degrees short, and the places' largest error in metres."""
    sigmas_deg = ([0.02] * 10 + [turn_sigma_deg]) * 4 + [loop_sigma_deg]
    covariances = [np.diag([np.radians(sigma) ** 2] * 3 + [0.01**2] * 3) for sigma in sigmas_deg]
    steps = _square(88.0)
    edges = [PoseEdge(k, k + 1, step, covariances[k], is_loop=False) for k, step in enumerate(steps)]
    edges.append(PoseEdge(0, len(steps), np.eye(4), covariances[-1], is_loop=True))
    found = optimize_pose_graph(driven(steps), edges)
    errors_m = np.linalg.norm(found.map_from_body[:, :3, 3] - driven(_square(90.0))[:, :3, 3], axis=1)
    return bool(found.loop_weights[0] > 0.5), float(errors_m.max())


@pytest.mark.parametrize("loop_sigma_deg", [0.1, 0.01])
def test_a_sure_loop_far_from_the_odometry_is_believed(loop_sigma_deg: float) -> None:
    """Four turns that are known to two degrees: ten thousand squared sigmas of the loop, four of the odometry. They take all of it."""
    believed, error_m = _closed(2.0, loop_sigma_deg)
    assert believed
    assert error_m < 0.02


def test_a_loop_that_contradicts_sure_odometry_is_refused() -> None:
    assert not _closed(0.02, 0.1)[0]


SEED, DRIFT_DEG = 4, 0.3  # the first drive along B lies five standard deviations from A, and A is all that is mapped


def test_wrong_loops_that_agree_outvote_the_odometry() -> None:
    assert doppelganger.mapped("robust", DRIFT_DEG, SEED)[1] > 10
    assert doppelganger.mapped("gate", DRIFT_DEG, SEED)[1] > 10


def test_who_asks_for_the_next_corridor_believes_none() -> None:
    _, wrong, right, there = doppelganger.mapped("gate and step", DRIFT_DEG, SEED)
    assert wrong == 0
    assert right > 0.9 * there
