"""Loops of a corridor's doppelganger, in the drive in which they fooled the gate."""

from studies import doppelganger

SEED, DRIFT_DEG = 4, 0.3  # the first drive along B lies five standard deviations from A, and A is all that is mapped


def test_wrong_loops_that_agree_outvote_the_odometry() -> None:
    assert doppelganger.mapped("robust", DRIFT_DEG, SEED)[1] > 10
    assert doppelganger.mapped("gate", DRIFT_DEG, SEED)[1] > 10


def test_who_asks_for_the_next_corridor_believes_none() -> None:
    _, wrong, right, there = doppelganger.mapped("gate and step", DRIFT_DEG, SEED)
    assert wrong == 0
    assert right > 0.9 * there
