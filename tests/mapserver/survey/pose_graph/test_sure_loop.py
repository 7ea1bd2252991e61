"""Loops that are surer than the drift that they close is large, and those of a corridor's doppelganger that fooled the gate."""

import numpy as np
import pytest

from studies import doppelganger, square


@pytest.mark.parametrize("loop_sigma_deg", [0.1, 0.01])
def test_a_sure_loop_far_from_the_odometry_is_believed(loop_sigma_deg: float) -> None:
    """Two degrees at each of four turns that are known to two degrees: ten thousand squared sigmas of the loop, four of the odometry."""
    row = square.closed(0.02, 2.0, loop_sigma_deg)
    assert row["loop"] == "believed"
    assert row["rms_m"] < 0.01
    assert row["in_turns_deg"] == pytest.approx(8.0, abs=0.1)


def test_a_loop_that_contradicts_sure_odometry_is_refused() -> None:
    assert square.closed(0.02, 0.02)["loop"] == "refused"


def test_the_end_of_the_open_square_is_the_closed_form() -> None:
    """10 m |1 - e^(4 i 88 deg)| / |1 - e^(i 88 deg)|."""
    turned = np.exp(1j * np.radians(88.0))
    assert square.raw()["end_m"] == pytest.approx(10 * abs(1 - turned**4) / abs(1 - turned), abs=1e-9)


def test_similarities_take_up_the_scale_that_rigid_poses_cannot() -> None:
    assert square.scaled(with_scale=True)["rms_m"] < 0.01
    assert square.scaled(with_scale=False)["rms_m"] > 0.2


SEED, DRIFT_DEG = 4, 0.3  # the first drive along B lies five standard deviations from A, and A is all that is mapped


def test_wrong_loops_that_agree_outvote_the_odometry() -> None:
    assert doppelganger.mapped("robust", DRIFT_DEG, SEED)[1] > 10
    assert doppelganger.mapped("gate", DRIFT_DEG, SEED)[1] > 10


def test_who_asks_for_the_next_corridor_believes_none() -> None:
    _, wrong, right, there = doppelganger.mapped("gate and step", DRIFT_DEG, SEED)
    assert wrong == 0
    assert right > 0.9 * there
