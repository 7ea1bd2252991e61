"""Position priors narrow the loops' gate: a look-alike aisle is refused, a true revisit is not, a wrong prior is left out."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.sensors.samples import PositionPrior
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999, GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.pose_graph.position_priors import learn_priors

_AISLE_M = 4.5
_STEP = np.diag(np.square([0.003, 0.003, 0.01, 0.03, 0.03, 0.03]))
_PERIOD_NS = 500_000_000
BASE_FROM_BODY = se3(np.eye(3), np.array([0.3, 0.1, 0.25]))


def _map_from_body(x_m: float, y_m: float, yaw_rad: float) -> Array:
    return se3(so3_exp(np.array([0.0, 0.0, yaw_rad])), np.array([x_m, y_m, 0.25]))


def _truth() -> Array:
    """Up one aisle of 60 m, down the next: bodies a metre apart, 121 of them."""
    up = [_map_from_body(float(x), 0.0, 0.0) for x in range(61)]
    return np.stack([*up, *[_map_from_body(60.0 - x, _AISLE_M, np.pi) for x in range(60)]])


def _graph(rng: np.random.Generator) -> tuple[GraphMarginals, Any]:
    """What odometry makes of it, in a frame of its own."""
    truth, edges, placed = _truth(), [], [np.eye(4)]
    for k in range(len(truth) - 1):
        error = rng.multivariate_normal(np.zeros(6), _STEP)
        off = se3(so3_exp(error[:3]), error[3:])
        step = off @ se3_inverse(truth[k]) @ truth[k + 1]
        edges.append(PoseEdge(k, k + 1, step, _STEP, is_loop=False))
        placed.append(placed[-1] @ step)
    odom_from_body = np.stack(placed)
    keyframes = [SimpleNamespace(frame_index=k) for k in range(len(truth))]
    estimates = [SimpleNamespace(stamp_ns=k * _PERIOD_NS) for k in range(len(truth))]
    odometry = SimpleNamespace(estimates=estimates, odom_from_body=odom_from_body, keyframes=keyframes)
    return GraphMarginals(odom_from_body, edges), odometry


def _priors(rng: np.random.Generator, moved_m: float = 0.0) -> list[PositionPrior]:
    """A dock at the start and a zone of a metre every ten metres; from the middle on they are so far aside."""
    truth, found = _truth(), []
    for k in range(0, len(truth), 10):
        variances = np.square([0.0, 0.0, 0.02, 0.05, 0.05, 0.02] if k == 0 else [0.0, 0.0, np.inf, 1.0, 1.0, 0.02])
        place = truth[k] @ se3_inverse(BASE_FROM_BODY)
        place[:2, 3] += rng.normal(0.0, np.sqrt(variances[3:5]))
        place[1, 3] += moved_m if k > 60 else 0.0
        found.append(PositionPrior(k * _PERIOD_NS, place, np.diag(variances)))
    return found


def _loop(i: int, j: int, aside_m: float = 0.0) -> PoseEdge:
    """What pictures measure of a revisit, of the same place one aisle aside."""
    truth = _truth()
    seen = truth[j].copy()
    seen[1, 3] += aside_m
    return PoseEdge(i, j, se3_inverse(truth[i]) @ seen, np.diag([0.01**2] * 3 + [0.05**2] * 3), is_loop=True)


def test_a_look_alike_aisle_is_refused_where_odometry_alone_would_take_it() -> None:
    rng = np.random.default_rng(3)
    told, odometry = _graph(rng)
    alone, _ = _graph(np.random.default_rng(3))
    assert learn_priors(told, _priors(rng), BASE_FROM_BODY, odometry) == 0
    assert alone.innovation_squared(_loop(118, 30, _AISLE_M)) < CHI2_6_0999
    assert told.innovation_squared(_loop(118, 30, _AISLE_M)) > CHI2_6_0999


def test_true_revisits_are_still_possible() -> None:
    refused = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        graph, odometry = _graph(rng)
        learn_priors(graph, _priors(rng), BASE_FROM_BODY, odometry)
        refused += sum(graph.innovation_squared(_loop(i, j)) > CHI2_6_0999 for i, j in ((118, 2), (90, 30), (61, 59)))
    assert refused == 0


def test_places_are_nearer_to_the_truth() -> None:
    before, after = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        graph, odometry = _graph(rng)
        before.append(np.linalg.norm(_off(graph)))
        learn_priors(graph, _priors(rng), BASE_FROM_BODY, odometry)
        after.append(np.linalg.norm(_off(graph)))
    assert np.median(after) < 0.5 * np.median(before)


def _off(graph: GraphMarginals) -> Array:
    truth, placed = _truth(), graph.map_from_body
    return np.asarray((se3_inverse(truth[0]) @ truth[-1])[:3, 3] - (se3_inverse(placed[0]) @ placed[-1])[:3, 3])


def test_priors_that_the_sensors_contradict_are_left_out() -> None:
    rng = np.random.default_rng(5)
    graph, odometry = _graph(rng)
    before = graph.map_from_body
    assert learn_priors(graph, _priors(rng, moved_m=80.0), BASE_FROM_BODY, odometry) == 6
    assert np.linalg.norm(graph.map_from_body[-1, :3, 3] - before[-1, :3, 3]) < 10.0


def test_positions_without_any_heading_say_nothing() -> None:
    rng = np.random.default_rng(6)
    graph, odometry = _graph(rng)
    assert learn_priors(graph, _priors(rng)[1:], BASE_FROM_BODY, odometry) == 0
    assert graph.learned == 0
