"""Pictures of a room become surfels that show it again; what moved is not among them, and a later drive takes over."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import so3_exp
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.version_grid import CELL_M, FREE, OCCUPIED, UNKNOWN, occupancy
from mapserver.drafting.draft_evidence import MappedSession
from mapserver.plugins.dense_maps.expected_view import expected_view, pinhole
from mapserver.plugins.dense_maps.exposure import Sample, estimate_exposure, lens_factor
from mapserver.plugins.dense_maps.site_grid import FREE as FREE_VIEWS
from mapserver.plugins.dense_maps.surfel_map import SurfelTiles
from mapserver.plugins.dense_maps.survey_grid import DepthView, GridGrower, grow
from mapserver.plugins.dense_maps.survey_surfels import SurfelGrower
from support.recordings.recording_samples import BASELINE_M, BODY_FROM_CAM0, FOCAL, HEIGHT, WIDTH
from support.storage.room_sessions import CAMERA, Seen, grown, ride, session_at
from support.worlds.box_room import ROOM_M, stereo_pair

NONE = SurfelTiles()
PLACES = ride([0.8] * 16)


def surfels(session: MappedSession, before: SurfelTiles = NONE) -> SurfelTiles:
    grower, without = grown(SurfelGrower(before), session)
    assert without == {}
    return grower.surfels


@pytest.mark.parametrize("has_depth", [False, True])
def test_a_room_is_shown_as_a_frame_that_was_left_out_saw_it(has_depth: bool) -> None:
    kept = [place for i, place in enumerate(PLACES) if i != 7]
    tiles = surfels(session_at(kept, has_depth=has_depth))
    shown = tiles.joined()
    off = np.abs(shown.points_map[:, None] - ROOM_M).min(axis=(1, 2))
    assert (off < 0.1).mean() > 0.97
    picture = stereo_pair(PLACES[7], 0).left.astype(float)
    view = expected_view(shown, pinhole(CAMERA), PLACES[7] @ BODY_FROM_CAM0)
    assert view.unknown.mean() < 0.2
    error = (view.picture - picture)[~view.unknown]
    flat = (picture - picture.mean())[~view.unknown]
    assert (error**2).mean() < 0.1 * (flat**2).mean()
    assert tiles.blobs() == surfels(session_at(kept, has_depth=has_depth)).blobs()


def with_box(session: MappedSession, shown: range) -> MappedSession:
    """The session of a depth camera before which something stands, in some of the frames."""
    for number in shown:
        seen = session.survey.odometry.keyframes[number]
        left, disparity = seen.frame.left.copy(), seen.frame.disparity_px.copy()
        left[80:160, 120:200], disparity[80:160, 120:200] = 255, FOCAL * BASELINE_M / 1.2
        session.survey.odometry.keyframes[number] = Seen(RectifiedFrame(number, left, None, disparity), number)
    return session


def in_the_way(surfels: SurfelTiles) -> int:
    """Surfels in the room's middle, where nothing of the room is."""
    return int((np.abs(surfels.joined().points_map[:, None] - ROOM_M).min(axis=(1, 2)) > 0.3).sum())


def test_what_later_views_see_through_is_gone_and_what_stands_stays() -> None:
    there = [PLACES[4]] * 12
    assert in_the_way(surfels(with_box(session_at(there, has_depth=True), range(3)))) == 0
    assert in_the_way(surfels(with_box(session_at(there, has_depth=True), range(12)))) > 300


def test_a_later_drive_takes_away_what_is_gone_and_keeps_what_it_does_not_see() -> None:
    there = [PLACES[4]] * 6
    first = surfels(with_box(session_at(there, has_depth=True), range(6)))
    assert in_the_way(first) > 300
    assert in_the_way(surfels(session_at(there, has_depth=True), first)) == 0
    away = [place.copy() for place in there]
    for place in away:
        place[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ place[:3, :3]  # to the wall behind
    both = surfels(session_at(away, has_depth=True), first)
    assert in_the_way(both) == in_the_way(first)
    assert len(both) > len(first)


def test_exposures_of_views_and_drives_are_evened_out_and_shown_again() -> None:
    """Each frame at its own exposure, a second drive at half the light: the view has the brightness of its neighbours."""
    rng = np.random.default_rng(2)

    def exposed(factors: np.ndarray) -> MappedSession:
        session = session_at(PLACES[:12], has_depth=True)
        for number, factor in enumerate(factors):
            seen = session.survey.odometry.keyframes[number]
            left = np.clip(seen.frame.left * factor, 0, 255).astype(np.uint8)
            session.survey.odometry.keyframes[number] = Seen(replace(seen.frame, left=left), number)
        return session

    factors = np.exp(np.cumsum(rng.normal(0, 0.05, 12))) * 0.7
    first = surfels(exposed(factors))
    second = surfels(exposed(factors * 0.5), first)
    plain = stereo_pair(PLACES[6], 0).left
    for tiles, factor in ((first, factors[6]), (second, 0.5 * factors[6])):
        view = expected_view(tiles.joined(), pinhole(CAMERA), PLACES[6] @ BODY_FROM_CAM0)
        ratio = np.median(view.picture[~view.unknown] / np.maximum(plain[~view.unknown] * factor, 1.0))
        assert abs(ratio - 1.0) < 0.12
    shown = [np.median(tiles.joined().greys) for tiles in (first, second)]
    assert abs(shown[1] / shown[0] - 1) < 0.1


def test_one_camera_adds_nothing_and_says_so() -> None:
    mono = session_at(PLACES[:3], StereoCamera(FOCAL, CAMERA.cx_px, CAMERA.cy_px, 0.0, WIDTH, HEIGHT))
    first, tiles = (
        surfels(session_at(PLACES[:4], has_depth=True)),
        grown(GridGrower({}), session_at(ride([0.8] * 6)))[0].tiles,
    )
    for grower in (SurfelGrower(first), GridGrower(tiles)):
        assert "no depth" in grown(grower, mono)[1]["ride"]
        assert getattr(grower, "surfels", first) == first
        assert getattr(grower, "tiles", tiles) == tiles


def test_exposure_and_lens_are_told_apart() -> None:
    rng = np.random.default_rng(3)
    light, bright = rng.normal(4, 0.5, 400), rng.normal(0, 0.2, 12)
    falloff = np.array([-1.4, 0.6, -0.2])
    samples = []
    for view in range(12):
        points = np.sort(rng.choice(400, 150, replace=False))
        squared = rng.uniform(0, 0.7, 150)
        logs = light[points] + bright[view] + np.log(lens_factor(squared, falloff)) + rng.normal(0, 0.03, 150)
        logs[:5] += 1.0  # a mirror's
        samples.append(Sample(points, np.full(150, view), squared, logs))
    found = estimate_exposure(samples, 12)
    np.testing.assert_allclose(found.logs, bright - bright.mean(), atol=0.03)
    at = np.linspace(0, 0.7, 8)
    np.testing.assert_allclose(lens_factor(at, found.falloff), lens_factor(at, falloff), rtol=0.04)
    assert not estimate_exposure([], 3).logs.any()


# Pictures of a room become its grid; what shows no depth or no floor is told by name.


@pytest.mark.parametrize("has_depth", [False, True])
def test_a_room_has_its_walls_and_nothing_behind_them(has_depth: bool) -> None:
    grower, without = grown(GridGrower({}), session_at(ride([0.8] * 12), has_depth=has_depth))
    assert without == {}
    grid = occupancy(grower.tiles, 1.1)
    rows, _ = np.nonzero(grid.cells == OCCUPIED)
    y = grid.map_from_grid[1, 3] + (rows + 0.5) * CELL_M
    assert len(rows) > 20
    assert (np.abs(y - ROOM_M[1, 1]) < 1.5 * CELL_M).mean() > 0.95
    free_rows, _ = np.nonzero(grid.cells == FREE)
    assert len(free_rows) > 500
    assert grid.map_from_grid[1, 3] + (free_rows.max() + 1) * CELL_M < ROOM_M[1, 1] + CELL_M
    assert (grid.cells[rows.max() + 2 :] == UNKNOWN).all()
    again, _ = grown(GridGrower({}), session_at(ride([0.8] * 12), has_depth=has_depth))
    assert all(np.array_equal(cells, again.tiles[place]) for place, cells in grower.tiles.items())


def test_a_camera_that_is_carried_by_hand_has_no_floor() -> None:
    _, without = grown(GridGrower({}), session_at(ride([0.6, 0.75, 0.9, 1.05, 1.2, 1.35])))
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
    grow({"counted": counted}, [session_at(lap, has_depth=True)], StereoSettings())
    assert counted.frames == list(range(len(lap)))
