"""Position priors narrow the loops' gate: a look-alike aisle is refused, a true revisit is not, a wrong prior is left out."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.sensors.samples import PositionPrior
from mapserver.survey.pose_graph import position_priors
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999, GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from mapserver.survey.state import OdometryPass, PriorTerm

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


def _graph(rng: np.random.Generator, bend_rad: float = 0.0) -> tuple[list[PoseEdge], Array, Any]:
    """What odometry makes of it, in a frame of its own; bend_rad: an error of the turn at the end of the aisle."""
    truth, edges, placed = _truth(), [], [_map_from_body(3.0, -2.0, 0.4)]
    for k in range(len(truth) - 1):
        error = rng.multivariate_normal(np.zeros(6), _STEP)
        error[2] += bend_rad if k == 60 else 0.0
        off = se3(so3_exp(error[:3]), error[3:])
        step = off @ se3_inverse(truth[k]) @ truth[k + 1]
        edges.append(PoseEdge(k, k + 1, step, _STEP, is_loop=False))
        placed.append(placed[-1] @ step)
    odom_from_body = np.stack(placed)
    frames: list[Any] = [SimpleNamespace(frame_index=k, stamp_ns=k * _PERIOD_NS) for k in range(len(truth))]
    certain = np.zeros((len(truth), 6, 6)), np.ones(len(truth), bool)
    return edges, odom_from_body, OdometryPass(frames, odom_from_body, *certain, frames, inertial=False)


def _priors(
    rng: np.random.Generator,
    moved_m: float = 0.0,
    docks: tuple[int, ...] = (0,),
    wrong: int | None = None,
    repeated: tuple[int, ...] = (),
) -> list[PositionPrior]:
    """Docks, and a zone of a metre every ten metres; from the middle on zones are so far aside, the wrong dock by twelve metres.

    Robots at `repeated` docks read them twenty times.
    """
    truth, found = _truth(), []
    for k in sorted({*range(0, len(truth), 10), *docks}):
        is_dock = k in docks
        variances = np.square([0.0, 0.0, 0.02, 0.05, 0.05, 0.02] if is_dock else [0.0, 0.0, np.inf, 1.0, 1.0, 0.02])
        if not is_dock and k == 0 and not docks:
            continue
        place = truth[k] @ se3_inverse(BASE_FROM_BODY)
        place[:2, 3] += rng.normal(0.0, np.sqrt(variances[3:5]))
        place[1, 3] += 12.0 if k == wrong else moved_m if k > 60 and not is_dock else 0.0
        samples = 20 if k in repeated else 1
        found += [PositionPrior(k * _PERIOD_NS + 10_000_000 * n, place, np.diag(variances)) for n in range(samples)]
    return found


def _loop(i: int, j: int, aside_m: float = 0.0) -> PoseEdge:
    """What pictures measure of a revisit, of the same place one aisle aside."""
    truth = _truth()
    seen = truth[j].copy()
    seen[1, 3] += aside_m
    return PoseEdge(i, j, se3_inverse(truth[i]) @ seen, np.diag([0.01**2] * 3 + [0.05**2] * 3), is_loop=True)


class Survey:
    """A chain of keyframes with the priors of its drive, learned by its graph."""

    def __init__(self, seed: int, bend_rad: float = 0.0, **how: Any) -> None:
        rng = np.random.default_rng(seed)
        self.edges, odom_from_body, odometry = _graph(rng, bend_rad)
        self.alone = GraphMarginals(odom_from_body, self.edges)
        self.placed, terms = position_priors.placed_by_priors(
            odom_from_body, self.alone, _priors(rng, **how), BASE_FROM_BODY, odometry
        )
        self.graph = GraphMarginals(self.placed, self.edges)
        self.priors = position_priors.learn_priors(self.graph, terms)

    @property
    def refused(self) -> int:
        return sum(not term.is_believed for term in self.priors)

    def solved(self) -> tuple[Array, list[bool]]:
        """map_from_body of the pose graph with the priors, and which of these it believes."""
        believed = [term for term in self.priors if term.is_believed]
        nodes, held = position_priors.prior_edges(self.placed, believed)
        found = optimize_pose_graph(nodes, [*self.edges, *held])
        there = position_priors.level(se3_inverse(found.map_from_body[-1]), believed[0].map_from_body)
        return there @ found.map_from_body[:-1], (found.loop_weights >= 0.5).tolist()


def test_a_look_alike_aisle_is_refused_where_odometry_alone_would_take_it() -> None:
    survey = Survey(3)
    assert survey.refused == 0
    assert survey.alone.innovation_squared(_loop(118, 30, _AISLE_M)) < CHI2_6_0999
    assert survey.graph.innovation_squared(_loop(118, 30, _AISLE_M)) > CHI2_6_0999


def test_true_revisits_are_still_possible() -> None:
    refused = 0
    for seed in range(20):
        graph = Survey(seed).graph
        refused += sum(graph.innovation_squared(_loop(i, j)) > CHI2_6_0999 for i, j in ((118, 2), (90, 30), (61, 59)))
    assert refused == 0


def test_places_are_nearer_to_the_truth() -> None:
    surveys = [Survey(seed) for seed in range(10)]
    before = [np.linalg.norm(_off(survey.placed)) for survey in surveys]
    after = [np.linalg.norm(_off(survey.graph.map_from_body)) for survey in surveys]
    assert np.median(after) < 0.5 * np.median(before)


def _off(placed: Array) -> Array:
    truth = _truth()
    return np.asarray((se3_inverse(truth[0]) @ truth[-1])[:3, 3] - (se3_inverse(placed[0]) @ placed[-1])[:3, 3])


def test_priors_that_the_sensors_contradict_are_left_out() -> None:
    survey = Survey(5, moved_m=80.0)
    assert survey.refused == 6
    assert np.linalg.norm(survey.graph.map_from_body[-1, :3, 3] - survey.placed[-1, :3, 3]) < 10.0


def test_positions_without_any_heading_give_the_frame_and_no_gate() -> None:
    survey = Survey(6, docks=())
    assert len(survey.priors) == 12
    assert survey.graph.learned == 0
    assert np.linalg.norm((survey.placed - _truth())[:, :2, 3], axis=1).mean() < 3.0


def test_positions_too_near_each_other_give_no_heading() -> None:
    edges, odom_from_body, odometry = _graph(np.random.default_rng(6))
    alone = GraphMarginals(odom_from_body, edges)
    variances = np.square([0.0, 0.0, np.inf, 1.0, 1.0, 0.02])
    for last, count in ((4, 0), (40, 2)):  # metres apart: sigmas of the yaw of 0.35 and 0.035 rad
        zones = [
            PositionPrior(k * _PERIOD_NS, _truth()[k] @ se3_inverse(BASE_FROM_BODY), np.diag(variances))
            for k in (0, last)
        ]
        placed, terms = position_priors.placed_by_priors(odom_from_body, alone, zones, BASE_FROM_BODY, odometry)
        assert len(terms) == count
        assert (placed is odom_from_body) is (count == 0)


def test_a_block_whose_yaw_drifts_is_held_by_two_docks() -> None:
    """Three degrees at the turn are 3.1 m at the end of the next aisle: odometry's covariance allows it, the docks do not."""
    bent_m = []
    for seed in range(5):
        survey = Survey(seed, bend_rad=0.05, docks=(0, 120))
        bent_m.append(np.linalg.norm(_off(survey.placed)))
        placed, believed = survey.solved()
        assert all(believed)
        assert (np.linalg.norm((placed - _truth())[[0, 120], :2, 3], axis=1) < 3 * 0.05).all()
    assert np.median(bent_m) > 1.0


@pytest.mark.parametrize("repeated", [(), (0,)])
def test_a_wrong_dock_is_not_obeyed_even_if_it_comes_first_or_often(repeated: tuple[int, ...]) -> None:
    """Samples of one visit have one vote."""
    survey = Survey(7, docks=(0, 50, 120), wrong=0, repeated=repeated)
    assert [term.k for term in survey.priors if not term.is_believed] == [0]
    assert np.linalg.norm((survey.solved()[0] - _truth())[[50, 120], :2, 3], axis=1).max() < 3 * 0.05


def test_samples_of_one_visit_weigh_as_one() -> None:
    once, often = Survey(8, docks=(0, 120)), Survey(8, docks=(0, 120), repeated=(0, 120))
    np.testing.assert_array_equal(often.solved()[0], once.solved()[0])
    passing = Survey(8, docks=(0, 50, 51, 52))
    assert [term.k for term in passing.priors if 50 <= term.k < 60] == [50]


def test_of_two_priors_that_contradict_at_one_keyframe_one_is_not_believed() -> None:
    survey = Survey(9)
    reference = survey.priors[0]
    aside = reference.map_from_body.copy()
    aside[1, 3] += 5.0
    twice = [reference, PriorTerm(reference.k, aside, reference.information)]
    assert [term.is_believed for term in position_priors.learn_priors(survey.graph, twice)] == [True, False]


def test_a_prior_beyond_its_own_covariance_is_no_longer_believed() -> None:
    truth = _truth()
    information = np.diag([1 / 0.02**2] * 3 + [1 / 0.05**2] * 3)
    aside = truth[60].copy()
    aside[1, 3] += 0.3
    priors = [PriorTerm(0, truth[0], information), PriorTerm(60, aside, information)]
    judged, unchanged = position_priors.judged_priors(priors, truth)
    assert [term.is_believed for term in judged] == [True, False]
    assert not unchanged
    assert position_priors.judged_priors(judged, truth)[1]
