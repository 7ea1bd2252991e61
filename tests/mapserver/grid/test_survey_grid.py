"""Pictures of a room become its grid; what shows no depth or no floor is told by name."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.mapformat.grid_tile import CELL_M
from fleetmap.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.version_grid import occupancy
from mapserver.grid.survey_grid import GridSession, grow_grid
from support.recordings.recording_samples import BASELINE_M, BODY_FROM_CAM0, FOCAL, HEIGHT, WIDTH
from support.worlds.box_room import ROOM_M, points_seen, stereo_pair

CAMERA = StereoCamera(FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5, BASELINE_M, WIDTH, HEIGHT)


@dataclass(frozen=True, slots=True)
class Seen:
    frame: RectifiedFrame
    frame_index: int


def session_at(places: list[Array], camera: StereoCamera = CAMERA, *, has_depth: bool = False) -> GridSession:
    """What a survey hands on of keyframes at these map_from_body."""
    keyframes = []
    for number, map_from_body in enumerate(places):
        pair, disparity = stereo_pair(map_from_body, number), None
        if has_depth:
            map_from_cam = map_from_body @ BODY_FROM_CAM0
            pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2)
            depth_m = (points_seen(map_from_cam, pixels) - map_from_cam[:3, 3]) @ map_from_cam[:3, 2]
            disparity = (FOCAL * BASELINE_M / depth_m).reshape(HEIGHT, WIDTH).astype(np.float32)
        right = None if has_depth else pair.right
        keyframes.append(Seen(RectifiedFrame(number, pair.left, right, disparity), number))
    survey = SimpleNamespace(
        odometry=SimpleNamespace(keyframes=keyframes),
        state=SimpleNamespace(camera=camera, body_from_cam=BODY_FROM_CAM0),
        stereo_yaw=SimpleNamespace(correction_px=0.0),
    )
    return GridSession("ride", survey, np.array(places))  # type: ignore[arg-type]


def ride(height_m: list[float]) -> list[Array]:
    """Along x at these heights over the floor, looking at the wall at y = 3, down by 0.2 rad."""
    down = so3_exp(np.array([0, 0, np.pi / 2])) @ so3_exp(np.array([0, 0.2, 0]))
    return [
        se3(down, np.array([-1.0 + 0.2 * n, 0.4 + 0.05 * n, ROOM_M[0, 2] + height]))
        for n, height in enumerate(height_m)
    ]


@pytest.mark.parametrize("has_depth", [False, True])
def test_a_room_has_its_walls_and_nothing_behind_them(has_depth: bool) -> None:
    tiles, without = grow_grid({}, [session_at(ride([0.8] * 12), has_depth=has_depth)], StereoSettings())
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
    again, _ = grow_grid({}, [session_at(ride([0.8] * 12), has_depth=has_depth)], StereoSettings())
    assert all(np.array_equal(cells, again[place]) for place, cells in tiles.items())


def test_a_camera_without_depth_keeps_what_was_known() -> None:
    before, _ = grow_grid({}, [session_at(ride([0.8] * 6))], StereoSettings())
    mono = StereoCamera(FOCAL, CAMERA.cx_px, CAMERA.cy_px, 0.0, WIDTH, HEIGHT)
    after, without = grow_grid(before, [session_at(ride([0.8] * 3), mono)], StereoSettings())
    assert after == before
    assert "no depth" in without["ride"]


def test_a_camera_that_is_carried_by_hand_has_no_floor() -> None:
    heights = [0.6, 0.75, 0.9, 1.05, 1.2, 1.35]
    _, without = grow_grid({}, [session_at(ride(heights))], StereoSettings())
    assert "carried by hand" in without["ride"]
