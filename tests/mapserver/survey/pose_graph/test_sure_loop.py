"""Loops that are surer than the drift that they close is large, and those of a corridor's doppelganger that fooled the gate."""

import numpy as np
import pytest

from fleetmap.geometry import se3, so3_exp
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from studies import doppelganger


def _square(turn_deg: float) -> list[np.ndarray]:
    """Steps of a metre, ten to a leg, and after each of the four legs a turn on the spot."""
    turn = se3(so3_exp(np.array([0.0, 0.0, np.radians(turn_deg)])), np.zeros(3))
    return ([se3(np.eye(3), np.array([1.0, 0.0, 0.0]))] * 10 + [turn]) * 4


def _driven(steps: list[np.ndarray]) -> np.ndarray:
    places = [np.eye(4)]
    for step in steps:
        places.append(places[-1] @ step)
    return np.array(places)


def _closed(turn_sigma_deg: float, loop_sigma_deg: float) -> tuple[bool, float]:
    """Whether the loop is believed that closes a square whose turns are two degrees short, and the places' largest error in metres."""
    sigmas_deg = ([0.02] * 10 + [turn_sigma_deg]) * 4 + [loop_sigma_deg]
    covariances = [np.diag([np.radians(sigma) ** 2] * 3 + [0.01**2] * 3) for sigma in sigmas_deg]
    steps = _square(88.0)
    edges = [PoseEdge(k, k + 1, step, covariances[k], is_loop=False) for k, step in enumerate(steps)]
    edges.append(PoseEdge(0, len(steps), np.eye(4), covariances[-1], is_loop=True))
    found = optimize_pose_graph(_driven(steps), edges)
    errors_m = np.linalg.norm(found.map_from_body[:, :3, 3] - _driven(_square(90.0))[:, :3, 3], axis=1)
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
