"""What a survey under way lacks."""

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, so3_exp
from mapserver.plugins.live_surveys.mapping_process import covered_cells, missing_directions
from mapserver.plugins.live_surveys.message import COVERAGE_CELL_M


def looking(positions_m: Array, yaw_rad: float) -> Array:
    """(K, 4, 4) cameras at positions (K, 2), whose optical axis is level and points along yaw."""
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turn = so3_exp(np.array([0.0, 0.0, yaw_rad])) @ forward
    return np.array([se3(turn, np.array([x, y, 1.0])) for x, y in positions_m.tolist()])


AISLE = np.column_stack([np.arange(0.5, 20.0, 0.5), np.full(39, 2.0)])


def test_an_aisle_driven_one_way_misses_the_other() -> None:
    east, west = looking(AISLE, 0.0), looking(AISLE, np.pi)
    missing = missing_directions(east)
    assert {each.heading for each in missing} == {"W"}
    assert sum(each.places for each in missing) == len(AISLE)
    for each in missing:
        assert each.y_m == pytest.approx(2.0)
        assert abs(each.x_m % COVERAGE_CELL_M - COVERAGE_CELL_M / 2) < 1.0
    assert missing_directions(np.concatenate([east, west])) == []


def test_a_square_is_covered_by_ten_landmarks() -> None:
    points = np.concatenate([np.full((10, 3), 1.0), np.full((9, 3), -1.0), np.full((30, 3), 6.0)])
    assert covered_cells(points, 10).tolist() == [[0, 0, 10], [1, 1, 30]]
    assert covered_cells(points, 1).tolist() == [[1, 1, 30]]
    assert covered_cells(points[:0], 10).shape == (0, 3)
