"""Confirmation of a map: cells that are seen again, and bounds of their share that know of their dependence."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import beta

from mapserver.survey.merge.confirmation import Confirmation, confirmation

RATE = 0.001
CELL_M = 0.75
PER_CELL = 8


def confirmed(
    cells: NDArray[np.int64], stands: NDArray[np.bool_], share: float, seed: int, looks: int = 3
) -> Confirmation:
    """Landmarks in `cells` (C, 3), each look finds `share` of those in cells that stand and one in five hundred of the others."""
    rng = np.random.default_rng(seed)
    points = CELL_M * (cells[:, None] + rng.uniform(0.05, 0.95, (len(cells), PER_CELL, 3))).reshape(-1, 3)
    chance = np.repeat(np.where(stands, share, 0.002), PER_CELL)
    rows = np.arange(len(points))
    return confirmation(
        points, [(rows, rng.random(len(rows)) < chance) for _ in range(looks)], np.ones(len(rows), bool), RATE
    )


def hall(count: int) -> NDArray[np.int64]:
    """Cells along an aisle, two high."""
    return np.array([(k // 2, 0, k % 2) for k in range(count)])


def test_all_cells_of_a_sound_map_are_seen() -> None:
    seen = confirmed(hall(60), np.ones(60, bool), 0.6, 1)
    assert seen.cells == seen.seen == 60
    assert seen.low == pytest.approx(float(beta.ppf(RATE, 60, 1)))
    assert seen.high == 1.0


def test_chance_confirms_no_cell() -> None:
    seen = confirmed(hall(60), np.zeros(60, bool), 0.4, 1)
    assert seen.seen <= 1
    assert seen.high < 0.5


def test_one_wall_full_of_landmarks_is_one_thing_among_many() -> None:
    """What a foreign hall shares: many landmarks, all of them in few cells."""
    cells, stands = hall(60), np.zeros(60, bool)
    stands[:10] = True
    seen = confirmed(cells, stands, 0.9, 2)
    assert seen.share < 0.25
    assert seen.low < 0.1
    assert seen.high < 0.65  # of thirty blocks four and a half are seen


def test_bounds_hold_for_cells_that_stay_or_go_by_whole_blocks() -> None:
    """Blocks of four cells share their fate: bounds for independent cells would be wrong in one case in ten, these are not."""
    rng, missed, naive = np.random.default_rng(7), 0, 0
    cells = np.array([(x, y, 0) for x in range(40) for y in range(2)])
    for seed in range(300):
        seen = confirmed(cells, np.repeat(rng.random(20) < 0.5, 4), 0.9, seed)
        missed += not seen.low <= 0.5 <= seen.high
        low = float(beta.ppf(RATE, max(seen.seen, 1), seen.cells - seen.seen + 1))
        naive += low > 0.5
    assert missed <= 6  # 2 x 0.001 of 300, the clusters' variance being itself estimated from twenty blocks
    assert naive > missed


def test_a_landmark_looked_for_once_and_an_infirm_one_do_not_count() -> None:
    rng = np.random.default_rng(3)
    points, rows = CELL_M * rng.uniform(0, 1, (20, 3)), np.arange(20)
    everything = np.ones(20, bool)
    assert confirmation(points, [(rows, everything)], everything, RATE).cells == 0
    assert confirmation(points, [(rows, everything)] * 2, ~everything, RATE).cells == 0
    nothing = confirmation(points, [], everything, RATE)
    assert (nothing.cells, nothing.low, nothing.high) == (0, 0.0, 1.0)
    assert confirmation(points, [(rows, everything)] * 2, everything, RATE).cells == 1
