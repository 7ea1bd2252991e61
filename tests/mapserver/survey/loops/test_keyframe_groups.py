"""Two groups of a survey: joined by revisits that agree over some way, and by nothing less."""

from itertools import pairwise

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from mapserver.survey.loops.keyframe_groups import KeyframeGroups, Revisit, WaitingRevisits
from mapserver.survey.pose_graph.graph_marginals import GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from support.worlds.pose_graph_scene import chain_of

SURE, LOST = np.diag([0.002**2] * 3 + [0.01**2] * 3), np.diag([1.5**2] * 3 + [15.0**2] * 3)
FIRST, SECOND = range(6), range(6, 12)


def truth() -> Array:
    """Half a metre a keyframe along an aisle; carried away, turned round, and set down where it comes back along the same aisle."""
    along = [se3(np.eye(3), np.array([0.5 * k, 0.0, 0.0])) for k in FIRST]
    back = [se3(so3_exp(np.array([0, 0, np.pi])), np.array([2.5 - 0.5 * k, 0.1, 0.0])) for k in FIRST]
    return np.array([*along, *back])


def marginals() -> GraphMarginals:
    """By odometry, which takes the second part to begin where the first one ended."""
    placed = truth()
    placed[6:] = placed[5] @ se3_inverse(placed[6]) @ placed[6:]
    return GraphMarginals(placed, chain_of(placed, [*[SURE] * 5, LOST, *[SURE] * 5]))


def groups() -> KeyframeGroups:
    return KeyframeGroups([*pairwise(FIRST), *pairwise(SECOND)], 12)


def seen_again(i: int, j: int, at: int | None = None) -> PoseEdge:
    """Keyframe i at old keyframe j as it is, or as it would be were it keyframe `at`."""
    placed = truth()
    return PoseEdge(i, j, se3_inverse(placed[i if at is None else at]) @ placed[j], SURE, is_loop=True)


def test_three_keyframes_over_a_metre_join_two_groups() -> None:
    waiting, graph = WaitingRevisits(), marginals()
    said = [waiting.add(Revisit(seen_again(6 + k, 5 - k), k), groups(), graph) for k in range(3)]
    assert [len(joined) for joined in said] == [0, 0, 3]
    assert [revisit.record for revisit in said[-1]] == [0, 1, 2]


@pytest.mark.parametrize(
    "looks",
    [
        [seen_again(6, 5), seen_again(6, 4), seen_again(6, 3)],  # one keyframe
        [seen_again(6, 5), seen_again(7, 4)],  # half a metre
        [seen_again(6 + k, 5, at=6) for k in range(6)],  # the same poster, bay after bay
        [seen_again(6 + k, 5 - k) for k in range(2)] + [seen_again(8 + k, 2, at=7 + k) for k in range(3)],
    ],
)
def test_what_looks_alike_here_and_there_does_not_join_them(looks: list[PoseEdge]) -> None:
    waiting, graph = WaitingRevisits(), marginals()
    assert [waiting.add(Revisit(edge, n), groups(), graph) for n, edge in enumerate(looks)] == [[]] * len(looks)


def test_a_part_that_was_turned_round_is_placed_as_it_is() -> None:
    graph = marginals()
    for k in range(3):
        graph.add(seen_again(6 + k, 5 - k))
    np.testing.assert_allclose(graph.map_from_body, truth(), atol=0.01)
    np.testing.assert_allclose(graph.linearised_at, truth(), atol=0.01)
    assert graph.relative_cov(11, 0)[3:, 3:].max() < 0.1
