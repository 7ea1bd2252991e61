"""Pictures of a room become its grid; what shows no depth or no floor is told by name."""

import numpy as np
import pytest

from fleetmap.mapformat.grid_tile import CELL_M
from fleetmap.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.version_grid import occupancy
from support.recordings.recording_samples import FOCAL, HEIGHT, WIDTH
from support.storage.room_sessions import CAMERA, grown_grid, ride, session_at
from support.worlds.box_room import ROOM_M


@pytest.mark.parametrize("has_depth", [False, True])
def test_a_room_has_its_walls_and_nothing_behind_them(has_depth: bool) -> None:
    tiles, without = grown_grid({}, [session_at(ride([0.8] * 12), has_depth=has_depth)])
    assert without == {}
    grid = occupancy(tiles, 1.1)
    rows, _ = np.nonzero(grid.cells == OCCUPIED)
    y = grid.map_from_grid[1, 3] + (rows + 0.5) * CELL_M
    assert len(rows) > 20
    assert (np.abs(y - ROOM_M[1, 1]) < 1.5 * CELL_M).mean() > 0.95
    free_rows, _ = np.nonzero(grid.cells == FREE)
    assert len(free_rows) > 500
    assert grid.map_from_grid[1, 3] + (free_rows.max() + 1) * CELL_M < ROOM_M[1, 1] + CELL_M
    assert (grid.cells[rows.max() + 2 :] == UNKNOWN).all()
    again, _ = grown_grid({}, [session_at(ride([0.8] * 12), has_depth=has_depth)])
    assert all(np.array_equal(cells, again[place]) for place, cells in tiles.items())


def test_a_camera_without_depth_keeps_what_was_known() -> None:
    before, _ = grown_grid({}, [session_at(ride([0.8] * 6))])
    mono = StereoCamera(FOCAL, CAMERA.cx_px, CAMERA.cy_px, 0.0, WIDTH, HEIGHT)
    after, without = grown_grid(before, [session_at(ride([0.8] * 3), mono)])
    assert after == before
    assert "no depth" in without["ride"]


def test_a_camera_that_is_carried_by_hand_has_no_floor() -> None:
    heights = [0.6, 0.75, 0.9, 1.05, 1.2, 1.35]
    _, without = grown_grid({}, [session_at(ride(heights))])
    assert "carried by hand" in without["ride"]
