"""Pictures of a room become its grid; what shows no depth or no floor is told by name."""

from collections.abc import Sequence

import numpy as np
import pytest

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import so3_exp
from fleetmap.mapformat.grid_tile import CELL_M
from fleetmap.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.version_grid import occupancy
from mapserver.drafting.extras import MappedSession
from mapserver.plugins.dense_maps.site_grid import FREE as FREE_VIEWS
from mapserver.plugins.dense_maps.survey_grid import DepthView, grow
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


class _Counted:
    """Keeps the numbers of the frames that it gets."""

    def begin(self, session: MappedSession, some: Sequence[DepthView]) -> str | None:
        self.frames, self.some = list[int](), {view.keyframe.frame_index: view for view in some}
        return None

    def add(self, view: DepthView) -> None:
        self.frames.append(view.keyframe.frame_index)
        assert self.some.get(view.keyframe.frame_index, view) is view  # matched once

    def end(self) -> None:
        """Nothing to do."""


def test_of_many_drives_along_a_way_the_last_ones_are_matched() -> None:
    """Enough of them to free a voxel; a place that was passed once, and one from which the camera looked elsewhere, stay."""
    lap = ride([0.8] * 21)[::3]
    away = lap[0].copy()
    away[:3, :3] = so3_exp(np.array([0.0, 0.0, 0.5])) @ away[:3, :3]
    counted = _Counted()
    grow({"counted": counted}, [session_at([away, *lap * 9], has_depth=True)], StereoSettings())
    assert counted.frames == [0, *range(1 + len(lap) * (9 - FREE_VIEWS), 1 + len(lap) * 9)]
    once = session_at(lap, has_depth=True)
    grow({"counted": counted}, [once], StereoSettings())
    assert counted.frames == list(range(len(lap)))
