"""Channels, read back by Foxglove's published schemas as another library has them."""

import json
import re

import cv2
import numpy as np
import pytest

from fleetmap.geometry import rotation_from_quat_wxyz, se3, so3_exp
from fleetmap.messages import FailureReport, Placement
from fleetmap.plugins.viewer_channels import channels
from fleetmap.plugins.viewer_channels.channels import CHANNELS, RobotMark
from fleetmap.sensors.rectification import StereoCamera
from support.fleet.contracts_documents import text
from support.fleet.foxglove_schemas import decoded, matrix, xyz

STAMP_NS = 1_700_000_000_123_456_789
TURNED = se3(so3_exp(np.array([0.1, -0.2, 0.7])), np.array([1.0, -2.0, 3.0]))


def ns(stamp) -> int:
    return stamp.seconds * 10**9 + stamp.nanos


def test_landmarks_are_float32_and_thinned_where_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).normal(size=(1000, 3))
    cloud = decoded(channels.points(STAMP_NS, points))
    assert (ns(cloud.timestamp), cloud.frame_id, cloud.point_stride) == (STAMP_NS, "map", 12)
    assert [(field.name, field.offset, field.type) for field in cloud.fields] == [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    np.testing.assert_array_equal(np.frombuffer(cloud.data, "<f4").reshape(-1, 3), points.astype(np.float32))
    monkeypatch.setattr(channels, "MAX_POINTS", 300)
    kept = np.frombuffer(decoded(channels.points(STAMP_NS, points)).data, "<f4").reshape(-1, 3)
    np.testing.assert_array_equal(kept, points[::4].astype(np.float32))


def test_a_long_path_keeps_its_last_position() -> None:
    positions = np.cumsum(np.ones((5000, 3)), axis=0)
    found = decoded(channels.path(STAMP_NS, positions))
    assert 1000 < len(found.poses) <= 2000
    np.testing.assert_array_equal(xyz(found.poses[-1].position), positions[-1])


def test_frames_and_robots_stand_where_they_are() -> None:
    link = decoded(channels.links(STAMP_NS, [("map", "odom", TURNED)])).transforms[0]
    assert (link.parent_frame_id, link.child_frame_id, ns(link.timestamp)) == ("map", "odom", STAMP_NS)
    np.testing.assert_allclose(xyz(link.translation), TURNED[:3, 3])
    turn = np.array([getattr(link.rotation, axis) for axis in "wxyz"])
    np.testing.assert_allclose(rotation_from_quat_wxyz(turn), TURNED[:3, :3], atol=1e-12)
    marks = [RobotMark("a", TURNED, "TRACKING"), RobotMark("b", np.eye(4), "LOST")]
    scene = decoded(channels.robots(STAMP_NS, marks))
    assert [deletion.type for deletion in scene.deletions] == [1], "those of before go"
    assert [(entity.id, entity.frame_id) for entity in scene.entities] == [("a", "map"), ("b", "map")]
    np.testing.assert_allclose(matrix(scene.entities[0].arrows[0].pose), TURNED, atol=1e-12)
    assert [entity.texts[0].text for entity in scene.entities] == ["a: TRACKING", "b: LOST"]
    np.testing.assert_allclose(matrix(decoded(channels.place("/fixes", STAMP_NS, TURNED)).pose), TURNED, atol=1e-12)
    for stamp_ns in (-5, 0, (1 << 62) - 1):  # impossible times are the nearest possible ones
        assert 0 <= decoded(channels.place("/fixes", stamp_ns, TURNED)).timestamp.seconds < 1 << 32


def test_images_have_their_lens_and_what_was_found_in_them() -> None:
    camera = StereoCamera(400.0, 320.5, 240.5, 0.1, 640, 480)
    lens = decoded(channels.lens(STAMP_NS, camera))
    assert (lens.width, lens.height, len(lens.D), len(lens.R)) == (640, 480, 5, 9)
    np.testing.assert_array_equal(np.reshape(lens.K, (3, 3)), camera.matrix)
    np.testing.assert_array_equal(np.reshape(lens.P, (3, 4))[:, :3], camera.matrix)
    left = np.tile(np.arange(64, dtype=np.uint8), (48, 1))
    image = decoded(channels.picture(STAMP_NS, left))
    assert (image.format, image.frame_id) == ("jpeg", "camera")
    shown = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(shown.astype(int) - left).max() < 10
    pixels, expected = np.array([[1.5, 2.5], [3.0, 4.0]]), np.array([[1.0, 2.0], [3.5, 4.5]])
    dots, lines = decoded(channels.matches(STAMP_NS, pixels, expected)).points
    assert [(dot.x, dot.y) for dot in dots.points] == [(1.5, 2.5), (3.0, 4.0)]
    assert [(end.x, end.y) for end in lines.points] == [(1.5, 2.5), (1.0, 2.0), (3.0, 4.0), (3.5, 4.5)]
    assert (dots.type, lines.type) == (1, 4)


def failure(**changes) -> FailureReport:
    known = {
        "site": "hall", "robot": "r1", "id": "x", "stamp_ns": 1, "wall_ns": 2, "duration_s": 3.0, "kind": "blind", "status": "LOST",
        "cause": "dark", "version": 4, "tile": (1, -2), "map_from_base": Placement.of(TURNED), "radius_95_m": float("inf"),
    }  # fmt: skip
    return FailureReport(**(known | changes))


def test_a_failure_has_line_place_pictures_and_report() -> None:
    found = channels.failure(STAMP_NS, failure(), [("frame", b"one"), ("matches", b"two")])
    topics = ["/failures/log", "/failures/place", "/failures/frame", "/failures/matches", "/failures/report"]
    assert [message.topic for message in found] == topics
    line = decoded(found[0])
    assert (line.level, line.name, line.message) == (4, "r1", "blind: dark, 3.0 s, version 4, tile 1,-2")
    np.testing.assert_allclose(matrix(decoded(found[1]).pose), TURNED, atol=1e-12)
    assert [decoded(message).data for message in found[2:4]] == [b"one", b"two"]
    assert b'"radius_95_m":null' in found[4].data
    assert b"thumbnails" not in found[4].data


def test_a_failure_nowhere_has_no_place() -> None:
    nowhere = Placement(position_m=(float("nan"), 0.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0))
    for placed in (None, nowhere):
        found = channels.failure(STAMP_NS, failure(map_from_base=placed, kind="suspected", tile=None), [])
        assert [message.topic for message in found] == ["/failures/log", "/failures/report"]
        assert decoded(found[0]).level == 3


# The layout in `deploy/` shows channels that there are, and every panel stands in it.

TEXT = text("deploy/foxglove-layout.json")


def test_it_shows_every_channel_that_there_is() -> None:
    assert set(re.findall(r'"(/[^"]*)"', TEXT)) == set(CHANNELS) - {"/tf"}, "frames are always drawn"


def test_every_panel_stands_in_it_once() -> None:
    layout = json.loads(TEXT)
    tabs = [panel["tabs"] for name, panel in layout["configById"].items() if name.startswith("Tab!")]
    placed = re.findall(r'"([^"]*![^"]*)"', json.dumps([layout["layout"], tabs]))
    assert sorted(placed) == sorted(layout["configById"])
