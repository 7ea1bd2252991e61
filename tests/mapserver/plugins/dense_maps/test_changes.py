"""Two versions of a room: what was brought, what was taken away, and what nobody looked at again."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetmap.geometry import se3_inverse
from fleetmap.sensors.rectification import RectifiedFrame
from mapserver.drafting.draft_evidence import MappedSession
from mapserver.plugins.dense_maps.changes import APPEARED, VANISHED, SeenSite, changes_between
from mapserver.plugins.dense_maps.surfel_map import Surfels, SurfelTiles
from mapserver.plugins.dense_maps.survey_surfels import SurfelGrower
from support.recordings.recording_samples import BASELINE_M, BODY_FROM_CAM0, FOCAL, HEIGHT
from support.storage.room_sessions import Seen, grown, ride, session_at

NONE = Surfels.joined([])
PLACES = [place for place in ride([0.8] * 8)[2:6] for _ in range(2)]
BOX_M = np.array([0.0, 1.6, -0.9])  # of the middle of a board of 0.5 m, before the wall
TANGENT = 0.5 * HEIGHT / FOCAL


def with_board(session: MappedSession) -> MappedSession:
    """The session of a depth camera before which a board stands, where its views have it."""
    for number, seen in enumerate(session.survey.odometry.keyframes):
        cam_from_map = se3_inverse(session.map_from_body[number] @ BODY_FROM_CAM0)
        corners = BOX_M + 0.25 * np.array([[i, 0.0, j] for i in (-1, 1) for j in (-1, 1)])
        points = corners @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]
        pixels = session.survey.state.rig.camera.pixel_from_point(points)
        (left, top), (right, bottom) = pixels[:, :2].min(axis=0).astype(int), pixels[:, :2].max(axis=0).astype(int)
        shown = np.s_[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
        grey, disparity = seen.frame.left.copy(), seen.frame.disparity_px.copy()
        grey[shown], disparity[shown] = 255, FOCAL * BASELINE_M / points[:, 2].mean()
        session.survey.odometry.keyframes[number] = Seen(RectifiedFrame(number, grey, None, disparity), number)
    return session


@pytest.fixture(scope="module")
def rooms() -> tuple[Surfels, Surfels, Surfels]:
    """The room, the night in which the board came, and the one in which it went again."""
    versions = [SurfelTiles()]
    for number in range(3):
        session = session_at(PLACES, has_depth=True)
        session = with_board(session) if number == 1 else session
        versions.append(grown(SurfelGrower(versions[-1]), session)[0].surfels)
    bare, board, bare_again = (tiles.joined() for tiles in versions[1:])
    return bare, board, bare_again


def site(surfels: Surfels) -> SeenSite:
    return SeenSite(surfels, TANGENT)


def test_what_came_and_what_went_is_found_where_it_stood(rooms: tuple[Surfels, Surfels, Surfels]) -> None:
    bare, board, bare_again = rooms
    for (before, after), kind in (((bare, board), APPEARED), ((board, bare_again), VANISHED)):
        changes = changes_between(site(before), site(after))
        assert [patch.kind for patch in changes.patches] == [kind]
        np.testing.assert_allclose(changes.patches[0].box_map.mean(axis=0), BOX_M, atol=0.12)
        assert 0.5 * 0.25 < changes.area_m2(kind) < 1.5 * 0.25
        rows, columns = np.nonzero(changes.layers[kind])
        places = changes.corner_m + (np.column_stack([columns, rows]) + 0.5) * 0.1
        assert np.abs(places - BOX_M[:2]).max() < 0.45
    assert not changes_between(site(bare), site(bare_again)).patches
    assert not changes_between(site(board), site(board)).patches


def test_what_the_other_did_not_look_at_is_not_said_to_have_changed(rooms: tuple[Surfels, Surfels, Surfels]) -> None:
    """The board stands where the other version's views do not reach: they are turned to the wall behind."""
    bare, board, _ = rooms
    away = bare.exposures.copy()
    away[:, 3:6] = -away[:, 3:6]
    for views in (away, np.zeros((0, 7))):
        changes = changes_between(site(replace(bare, exposures=views)), site(board))
        assert not changes.patches
        assert changes.layers["not_seen"].any()


def test_hidden_places_are_not_said_to_have_changed(rooms: tuple[Surfels, Surfels, Surfels]) -> None:
    """A board behind the wall that the other version saw: nobody could look there."""
    bare, board, _ = rooms
    brought = board[np.abs(board.points_map - BOX_M.astype(np.float32)).max(axis=1) < 0.3]
    behind = replace(brought, points_map=brought.points_map + np.array([0.0, 3.0, 0.0], np.float32))
    changes = changes_between(site(bare), site(replace(Surfels.joined([bare, behind]), exposures=bare.exposures)))
    assert not changes.patches


def test_versions_without_surfels_and_wild_places_are_refused(rooms: tuple[Surfels, Surfels, Surfels]) -> None:
    with pytest.raises(UsageError, match="without surfels"):
        changes_between(site(NONE), site(rooms[0]))
    far = replace(rooms[0], points_map=rooms[0].points_map * np.float32(1e4))
    with pytest.raises(UsageError, match="cells"):
        changes_between(site(far), site(rooms[0]))
