"""The graph of similarities: derivatives, scale drift taken up by a loop, wrong loops, and how loops measure the scale."""

from itertools import repeat

import numpy as np
import pytest

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, align_points, se3, se3_exp, se3_inverse, so3_exp, transform_points
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.pose_graph.sim3_pose_graph import gate_covariances, measured_log_scale, solve_scaled
from support.worlds.pose_graph_scene import chain_of

COUNT = 120
CHAIN_COV = np.diag([0.002**2] * 3 + [0.008**2] * 3)
LOOP_COV = np.diag([0.003**2] * 3 + [0.01**2] * 3)
WALK = 0.01


def circle() -> Array:
    """map_from_body (K, 4, 4): one lap of 80 m that ends where it began."""
    angle = 2 * np.pi * np.arange(COUNT) / (COUNT - 1)
    places_m = np.column_stack([12.7 * np.cos(angle), 12.7 * np.sin(angle), 0.2 * np.sin(2 * angle)])
    headings = (so3_exp(np.array([0.0, 0.0, a + np.pi / 2])) for a in angle)
    return np.array([se3(heading, place_m) for heading, place_m in zip(headings, places_m, strict=True)])


def drifted(truth: Array, drift: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """The chain (K, 4, 4) as one camera would have it, whose lengths grow by `drift` from start to end; and its scale (K,)."""
    scale = np.exp(np.log1p(drift) * np.arange(COUNT) / (COUNT - 1))
    places = [truth[0]]
    for k in range(COUNT - 1):
        step = se3_inverse(truth[k]) @ truth[k + 1]
        step[:3, 3] *= scale[k]
        places.append(places[-1] @ step @ se3_exp(rng.multivariate_normal(np.zeros(6), 0.1 * CHAIN_COV)))
    return np.array(places), scale


def scale_errors(found: Array, truth: Array) -> tuple[float, float]:
    """After one similarity: largest error in metres, and how far the scale of tenths of the way still wanders."""
    placed, scale = align_points(truth[:, :3, 3], found[:, :3, 3], with_scale=True)
    errors = np.linalg.norm(transform_points(placed, scale * found[:, :3, 3]) - truth[:, :3, 3], axis=1)
    steps = [np.linalg.norm(np.diff(m[:, :3, 3], axis=0), axis=1) for m in (found, truth)]
    parts = [s[: 10 * (len(s) // 10)].reshape(10, -1).sum(axis=1) for s in steps]
    ratio = scale * parts[0] / parts[1]
    return float(errors.max()), float(np.abs(ratio - 1).max())


def test_five_percent_of_scale_drift_go_with_one_loop() -> None:
    rng = np.random.default_rng(1)
    truth = circle()
    start, scale = drifted(truth, 0.05, rng)
    before_m, before = scale_errors(start, truth)
    last_from_first = se3_inverse(truth[-1]) @ truth[0]  # measured in lengths of the first
    loop = PoseEdge(
        COUNT - 1, 0, se3_exp(rng.multivariate_normal(np.zeros(6), LOOP_COV)) @ last_from_first, LOOP_COV, is_loop=True
    )
    measured = {(COUNT - 1, 0): (float(np.log(scale[-1] / scale[0])) + 0.002 * rng.normal(), 0.003)}
    map_from_body, weights = solve_scaled(start, chain_of(start, repeat(CHAIN_COV)), [loop], measured, WALK)
    after_m, after = scale_errors(map_from_body, truth)
    assert before > 0.02
    assert weights.tolist() == [1.0]
    assert after < 0.005
    assert after_m < 0.25 * before_m
    # a rigid graph bends the lap instead: what similarities are for
    rigid_scales = {(COUNT - 1, 0): (0.0, 1e-4)}
    bent, _ = solve_scaled(start, chain_of(start, repeat(CHAIN_COV)), [loop], rigid_scales, 1e-5)
    assert scale_errors(bent, truth)[1] > 2 * after


def test_a_wrong_loop_is_disbelieved() -> None:
    rng = np.random.default_rng(2)
    truth = circle()
    start, scale = drifted(truth, 0.05, rng)
    pairs = [(COUNT - 1, 0), (COUNT - 2, 1), (COUNT - 3, 2), (70, 20)]
    loops = [PoseEdge(i, j, se3_inverse(truth[i]) @ truth[j], LOOP_COV, is_loop=True) for i, j in pairs[:3]]
    loops.append(PoseEdge(70, 20, np.eye(4), LOOP_COV, is_loop=True))
    measured = {(i, j): (float(np.log(scale[i] / scale[j])), 0.005) for i, j in pairs}
    # what the loop measures has lengths of the old keyframe
    for n, (_, j) in enumerate(pairs[:3]):
        loops[n].i_from_j[:3, 3] *= scale[j]
    map_from_body, weights = solve_scaled(start, chain_of(start, repeat(CHAIN_COV)), loops, measured, WALK)
    assert weights.tolist() == [1.0, 1.0, 1.0, 0.0]
    assert scale_errors(map_from_body, truth)[1] < 0.005


def test_edges_that_cannot_be_solved_are_named() -> None:
    start = circle()[:4]
    chain, loop = chain_of(start, repeat(CHAIN_COV)), PoseEdge(3, 0, np.eye(4), np.nan * LOOP_COV, is_loop=True)
    for edges, loops, reason in ((chain[:1], [], r"\[2, 3\]"), (chain, [loop], "edge 3-0: .* not finite")):
        with pytest.raises(SurveyError, match=reason):
            solve_scaled(start, edges, loops, {}, WALK)


def test_points_of_both_keyframes_measure_the_scale() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform([-3, -2, 4], [3, 2, 9], (60, 3))
    j_from_i = se3(so3_exp(np.array([0.0, 0.2, 0.0])), np.array([0.4, 0.0, -0.3]))
    there = 1.08 * transform_points(j_from_i, points) * (1 + 0.01 * rng.normal(size=(60, 1)))
    there[:15] = rng.uniform(-5, 5, (15, 3))
    there[15:20] = np.nan
    log_scale, sigma = measured_log_scale(points, there, j_from_i)
    assert log_scale == pytest.approx(np.log(1.08), abs=3 * sigma)
    assert sigma < 0.02
    assert measured_log_scale(points[:5], there[20:25], j_from_i) == (0.0, 1.0)


def test_the_gate_widens_with_the_way() -> None:
    """The end's spread after a random walk of the scale, against the sum of the widened edges: never less."""
    truth = circle()
    chain = chain_of(truth, repeat(CHAIN_COV))
    widened = gate_covariances(chain, WALK)
    total = sum(e.cov_rot_trans[3, 3] - c.cov_rot_trans[3, 3] for e, c in zip(widened, chain, strict=True))
    rng = np.random.default_rng(4)
    steps = np.diff(truth[:, :3, 3], axis=0)
    half = COUNT // 2
    ends = [(np.exp(np.cumsum(WALK * rng.normal(size=half)))[:, None] * steps[:half]).sum(axis=0) for _ in range(400)]
    assert np.sqrt(total) > np.std(ends, axis=0).max()
