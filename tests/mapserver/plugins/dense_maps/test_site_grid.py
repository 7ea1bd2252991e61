"""Rays through cells against a brute-force reference, and what many views make of a cell."""

from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.version_grid import CELL_M, FLOOR_M, SLICE_M, SLICES, Counts, occupancy
from mapserver.plugins.dense_maps.dense_stereo import STEP_PX, floor_distance_m, nearest_around
from mapserver.plugins.dense_maps.site_grid import REACH_PX, SessionViews, height_map, updated

CAMERA = StereoCamera(60.0, 31.5, 23.5, 0.12, 64, 48)
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
SIGMA_PX, HEIGHT_M = 0.05, 0.9
PASSED, HIDDEN, MAX_HIT_SIGMA_M, RAY_STRIDE = 1, 2, 0.08, 2  # as grid.cpp has them


def brute_force(
    disparity: NDArray[np.float32], nearest: NDArray[np.float32], turn: Array, place: Array, was_free: NDArray[np.uint8]
) -> tuple[Array, Array]:
    """Points in voxels, and voxels that rays pass or would pass: every ray is cut at every line of the grid that it crosses."""
    shape = (*was_free.shape, SLICES)
    points, looks = np.zeros(shape), np.zeros(shape, np.uint8)
    for v, u in np.argwhere(disparity > 0):
        depth = CAMERA.focal_px * CAMERA.baseline_m / float(disparity[v, u])
        sigma = depth**2 / (CAMERA.focal_px * CAMERA.baseline_m) * SIGMA_PX
        off_px = np.array([STEP_PX * u - CAMERA.cx_px, STEP_PX * v - CAMERA.cy_px])
        ray = turn @ np.append(off_px / CAMERA.focal_px, 1.0) * depth
        ray[:2] /= CELL_M
        end = place + ray
        if end[2] < -0.15:
            continue
        is_news = False
        if sigma <= MAX_HIT_SIGMA_M and end[2] >= FLOOR_M:
            voxel = (int(np.floor(end[1])), int(np.floor(end[0])), int((end[2] - FLOOR_M) / SLICE_M))
            if all(0 <= i < n for i, n in zip(voxel, shape, strict=True)):
                points[voxel] += 1
                is_news = bool(was_free[voxel[:2]] >> voxel[2] & 1)
        if v % RAY_STRIDE or u % RAY_STRIDE:
            continue
        to_floor = sigma <= MAX_HIT_SIGMA_M and end[2] < FLOOR_M
        until = 1.0 if to_floor else 1.0 - (3.0 * sigma + CELL_M) / depth
        until = min(until, CAMERA.focal_px * CAMERA.baseline_m / float(nearest[v, u]) / depth)
        crossed = [0.0, max(until, 0.0)]
        for axis in (0, 1):
            lines = (np.arange(shape[1 - axis] + 1) - place[axis]) / ray[axis]
            crossed += [t for t in lines if 0 < t < until or (is_news and t > max(until, 0.0))]
        for first, last in zip(sorted(crossed), sorted(crossed)[1:], strict=False):
            middle = place + 0.5 * (first + last) * ray
            level = max(0, int((middle[2] - FLOOR_M) / SLICE_M))
            row, column = int(np.floor(middle[1])), int(np.floor(middle[0]))
            if not (0 <= row < shape[0] and 0 <= column < shape[1]):
                break
            if first > 1.0 and middle[2] < 0:
                break
            if level < SLICES and last - first > 1e-9 and (last <= until or first >= 1.0):
                looks[row, column, level] |= PASSED if last <= until else HIDDEN
    return points, looks


@pytest.mark.parametrize("seed", range(6))
def test_rays_as_by_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    disparity = (CAMERA.focal_px * CAMERA.baseline_m / rng.uniform(0.5, 6.0, (48, 64))).astype(np.float32)
    disparity[rng.random((48, 64)) < 0.3] = np.nan
    turn = so3_exp(np.array([*rng.normal(0, 0.1, 2), rng.uniform(-3, 3)])) @ OPTICAL
    place = np.array([40.3, 40.7, HEIGHT_M])
    nearest = np.nan_to_num(disparity) * np.where(rng.random((48, 64)) < 0.3, np.float32(1.7), np.float32(1.0))
    was_free = rng.integers(0, 256, (81, 81), np.uint8)
    points, looks, _ = core.cast_view(disparity, nearest, SIGMA_PX, CAMERA.lens, turn, place, was_free)
    wanted_points, wanted = brute_force(disparity, nearest, turn, place, was_free)
    # float32 disparities: a point may fall on the other side of a line.
    assert np.abs(points.astype(int) - wanted_points).sum() <= 4
    assert wanted_points.sum() > 100
    for mark, least in ((PASSED, 300), (HIDDEN, 100)):
        assert ((looks & mark) != (wanted & mark)).sum() <= 4 + 0.01 * (wanted & mark).astype(bool).sum()
        assert (wanted & mark).astype(bool).sum() > least


def wall_views(
    wall_x_m: float,
    places_x_m: Array,
    *,
    wall: bool = True,
    high_m: float = 1.2,
    before: Mapping[tuple[int, int], Counts] | None = None,
) -> SessionViews:
    """A camera that drives along x towards a wall so high across its way, over a floor that a hall ends at x = 9 m."""
    views, lens = SessionViews(before or {}), StereoCamera(420.0, 319.5, 239.5, 0.12, 640, 480)
    v, u = np.mgrid[0:480:STEP_PX, 0:640:STEP_PX]
    across, down = (u - lens.cx_px) / lens.focal_px, (v - lens.cy_px) / lens.focal_px
    for x in places_x_m:
        with np.errstate(divide="ignore"):
            depth = np.minimum(np.where(down > 0, HEIGHT_M / down, np.inf), 9.0 - x)
        to_wall = wall_x_m - x
        height_m = HEIGHT_M - down * to_wall
        hits = wall & (to_wall > 0) & (height_m > 0) & (height_m < high_m) & (np.abs(across * to_wall) < 2)
        depth = np.where(hits, np.minimum(depth, to_wall), depth)
        disparity = np.where(np.isfinite(depth), lens.focal_px * lens.baseline_m / depth, np.nan).astype(np.float32)
        map_from_cam = se3(OPTICAL, np.array([x, 0.02, 5.0 + HEIGHT_M]))
        views.add((disparity, nearest_around(disparity, REACH_PX), 0.3), lens, map_from_cam, HEIGHT_M)
    return views


def cell(grid: object, x_m: float, y_m: float) -> int:
    corner = grid.map_from_grid[:2, 3]
    column, row = ((np.array([x_m, y_m]) - corner) / CELL_M).astype(int)
    inside = 0 <= row < grid.cells.shape[0] and 0 <= column < grid.cells.shape[1]
    return int(grid.cells[row, column]) if inside else -1


def test_a_wall_is_occupied_before_it_is_free_and_behind_it_unknown() -> None:
    tiles = updated(wall_views(5.02, np.arange(0.0, 3.5, 0.25)))
    grid = occupancy(tiles, 1.1)
    assert [cell(grid, x, 0.0) for x in (3.0, 4.5, 5.02, 5.5, 9.0)] == [0, 0, 100, -1, -1]
    # Over the wall nothing is known of what stands behind it, but a robot that is lower than 2 m may not pass it.
    assert cell(occupancy(tiles, 2.1), 5.02, 0.0) == 100
    surfaces, where = height_map(tiles)
    column, row = ((np.array([5.02, 0.0]) - where.map_from_grid[:2, 3]) / CELL_M).astype(int)
    assert surfaces[1, row, column] == pytest.approx(1.2, abs=0.03)
    assert abs(surfaces[1, row, column - 40]) < 0.03


def test_what_many_look_over_stands_where_some_see_it() -> None:
    """An empty pallet: rays from afar pass over it, in the same voxels."""
    views = wall_views(5.02, np.arange(-4.0, 2.75, 0.25), high_m=0.16)
    assert cell(occupancy(updated(views), 1.1), 5.02, 0.0) == 100
    hits, passes = (views.tiles[0, 0][i][0, 100, 0] for i in (0, 1))
    assert 3 <= hits <= 6 and passes > 2 * hits
    gone = wall_views(5.02, np.arange(-4.0, 2.75, 0.25), wall=False, before=updated(views))
    assert cell(occupancy(updated(gone), 1.1), 5.02, 0.0) == 0


def test_what_is_gone_the_next_night_is_free_and_what_was_not_seen_stays() -> None:
    first = updated(wall_views(5.02, np.arange(0.0, 3.5, 0.25)))
    second = updated(wall_views(5.02, np.arange(1.0, 3.5, 0.25), wall=False, before=first))
    assert cell(occupancy(second, 1.1), 5.02, 0.0) == 0
    third = updated(wall_views(5.02, np.arange(-40.0, -39.0, 0.25), wall=False, before=first))
    assert cell(occupancy(third, 1.1), 5.02, 0.0) == 100


def test_behind_what_came_nothing_is_known_any_more() -> None:
    def drive(first_m: float, last_m: float, before: Mapping[tuple[int, int], Counts], *, wall: bool) -> list[int]:
        tiles.append(updated(wall_views(5.02, np.arange(first_m, last_m, 0.25), wall=wall, before=before)))
        return [cell(occupancy(tiles[-1], 1.1), x, 0.0) for x in (4.5, 5.02, 5.5, 8.0)]

    tiles: list[Mapping[tuple[int, int], Counts]] = []
    assert drive(0.0, 6.0, {}, wall=False) == [0, 0, 0, 0]
    assert drive(0.0, 3.5, tiles[-1], wall=True) == [0, 100, -1, -1]
    # What is seen from behind stays, also while the same wall hides it again.
    assert drive(5.2, 8.0, tiles[-1], wall=True)[3] == 0
    assert drive(0.0, 3.5, tiles[-1], wall=True)[3] == 0


def test_nothing_is_free_beside_the_edge_of_a_thing() -> None:
    """Depths of the wall behind among those of a post, as a matcher gives them at its edge."""
    lens = StereoCamera(420.0, 319.5, 239.5, 0.12, 640, 480)
    px = lens.focal_px * lens.baseline_m
    disparity = np.full((240, 320), px / 5.0, np.float32)
    disparity[:, 150:170] = px / 2.0
    views = SessionViews()
    for _ in range(8):
        disparity[:, 148:152] = px / 5.0  # an edge that lies 4 px within the post
        view = disparity, nearest_around(disparity, REACH_PX), 0.3
        views.add(view, lens, se3(OPTICAL, np.array([0.0, 0.0, HEIGHT_M])), HEIGHT_M)
    grid = occupancy(updated(views), 0.8)
    left_m = (319.5 - 302) * 2.0 / 420.0
    assert cell(grid, 1.5, left_m * 0.75) == 0
    assert cell(grid, 2.3, left_m * 1.15) != 0


def test_a_night_that_sees_the_same_changes_nothing() -> None:
    first = updated(wall_views(5.02, np.arange(0.0, 3.5, 0.25)))
    second = updated(wall_views(5.02, np.arange(0.0, 3.5, 0.25), before=first))
    changed = sum((first[place] != second[place]).any(axis=-1).sum() for place in first)
    assert changed < 0.02 * sum((cells != 0).any(axis=-1).sum() for cells in first.values())


def test_something_that_moves_leaves_no_trace() -> None:
    """A wall that three of fourteen views see, in the way of the others."""
    views = wall_views(3.02, np.array([0.5, 0.75, 1.0]))
    rest = wall_views(5.02, np.arange(0.0, 3.0, 0.2))
    for place, arrays in rest.tiles.items():
        for mine, other in zip(views.tiles.get(place, arrays), arrays, strict=True):
            if mine is not other and mine.shape[-1] == SLICES:
                np.add(mine, other, out=mine)
        views.tiles.setdefault(place, arrays)
    assert cell(occupancy(updated(views), 1.1), 3.02, 0.0) == 0


def test_the_floor_is_found_or_it_is_said_that_there_is_none() -> None:
    lens = StereoCamera(420.0, 319.5, 239.5, 0.12, 640, 480)
    v, _ = np.mgrid[0:480:STEP_PX, 0:640:STEP_PX]
    down = (v - lens.cy_px) / lens.focal_px

    def view(height_m: float) -> tuple[NDArray[np.float32], Array]:
        depth = np.where(down > 0.05, height_m / np.maximum(down, 1e-6), np.nan)
        return (lens.focal_px * lens.baseline_m / depth).astype(np.float32), se3(OPTICAL, np.array([1.0, 2.0, 7.0]))

    assert floor_distance_m([view(0.9)] * 5, lens) == pytest.approx(0.9, abs=0.011)
    assert floor_distance_m([view(height) for height in (0.6, 0.9, 1.2, 1.5, 1.1)], lens) is None
    assert floor_distance_m([], lens) is None


def test_where_the_camera_drove_nothing_stands() -> None:
    """From end to end of a drive, as high as the camera, in tiles of both signs; not where it was carried off and put down."""
    views = SessionViews()
    views.add_path(np.array([[-1.0, 0.0, 0.9], [0.0, 0.0, 0.9], [1.0, 0.2, 0.9], [9.0, 0.2, 0.9]]), 0.9)
    grid = occupancy(updated(views), 0.8)
    assert [cell(grid, *place) for place in ((-1.0, 0.1), (0.0, -0.2), (0.5, 0.1), (1.2, 0.2))] == [0, 0, 0, 0]
    assert [cell(grid, *place) for place in ((0.0, 0.4), (5.0, 0.2), (9.0, 0.2))] == [-1, -1, -1]
    assert (occupancy(updated(views), 1.3).cells == -1).all()
