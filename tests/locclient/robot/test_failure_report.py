"""The report of a failure: numbers, small pictures, and what the map expected beside what was seen."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from fleetmap.geometry import se3, so3_exp
from fleetmap.messages import MAX_MESSAGE_BYTES, MAX_THUMBNAIL_BYTES, encode_message
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import CameraFrame
from locclient.config import LocclientConfig
from locclient.delivery.report_delivery import write_failure
from locclient.robot.failure_report import (
    RobotProfile,
    expected_matches,
    failure_report,
    match_view,
    small_jpeg,
    without_detail,
)
from mapserver.store import MapStore
from support.worlds import robot_world


def frame(index: int) -> RectifiedFrame:
    sample = robot_world.cycle()
    return robot_world.rectifier().rectify(CameraFrame(5, sample.left[index], sample.right[index]))


def green(picture: np.ndarray) -> int:
    return int(((picture[..., 1] > 180) & (picture[..., 0] < 100) & (picture[..., 2] < 100)).sum())


def grey(jpeg: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)


def is_like(jpeg: bytes, left: np.ndarray, other: np.ndarray) -> bool:
    """Whether the picture under what is drawn over a match view is rather `left` than `other`."""
    view = grey(jpeg)
    under = view[-(view.shape[1] // 2) * left.shape[0] // left.shape[1] :, : view.shape[1] // 2]
    shown = (cv2.resize(np.asarray(each, np.float64), under.shape[::-1]) for each in (left, other))
    to_left, to_other = (np.median(np.abs(under - each)) for each in shown)
    return bool(to_left < to_other)


def test_the_match_view_tells_the_right_place_from_a_wrong_one() -> None:
    rig, left = robot_world.rectifier(), frame(30).left
    right_place = robot_world.truth(30) @ rig.body_from_cam
    wrong_place = se3(np.eye(3), np.array([1.0, 0.0, 0.0])) @ right_place
    views = [
        match_view(left, expected_matches(left, rig.camera, place, robot_world.tiles(), robot_world.SETTINGS), "test")
        for place in (right_place, wrong_place)
    ]
    assert views[0].shape == (rig.camera.height_px + 30, 2 * rig.camera.width_px, 3)
    assert green(views[0]) > 2 * green(views[1])
    dark = np.zeros_like(left)
    nowhere = match_view(dark, expected_matches(dark, rig.camera, right_place, [], robot_world.SETTINGS), "dark")
    assert green(nowhere) == 0


def test_pictures_are_small() -> None:
    noise = np.asarray(np.random.default_rng(0).integers(0, 255, (480, 1280, 3)), np.uint8)
    for limit in (MAX_THUMBNAIL_BYTES, 4000, 900):
        data = small_jpeg(noise, 800, limit)
        assert len(data) <= limit
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED).shape[1] <= 800


def test_a_dark_robot_reports_itself(tmp_path: Path, store: MapStore) -> None:
    """Expected: blind, dark, DEGRADED or LOST, the tile it was last in, pictures from before and from that moment."""
    ride = robot_world.bundles(130, dark=range(60, 130))
    (told,) = filter(None, (outcome.failure for outcome in map(robot_world.new_robot(store).handle, ride)))
    assert told.failure.estimate.cause is told.failure.estimate.image.cause is told.failure.cause
    rig = robot_world.rectifier()
    base_from_body = se3(so3_exp(np.array([0.0, 0.1, 0.4])), np.array([0.2, -0.1, 0.5]))
    mounting = replace(rig.calibration, base_from_body=base_from_body)
    profile = RobotProfile("room", "r1", rig.rig._replace(calibration=mounting), robot_world.SETTINGS)
    report = failure_report(told, profile, report_id="ab" * 16, wall_ns=7)
    assert (report.kind, report.cause, report.version) == ("blind", "dark", 1)
    assert report.status in {"DEGRADED", "LOST"}
    assert report.tile in {(-1, 0), (0, 0)}
    assert report.exposure == 0.0
    assert report.inliers is not None
    evidence = report.evidence
    assert (evidence.view_percent, evidence.broke, evidence.places) == (0, False, ())
    assert 5 < evidence.usual_percent <= 100
    x, y = np.transpose(evidence.cells)[:2] + np.floor(report.map_from_base.target_from_source[:2, 3:])
    assert np.abs([x, y]).max() < 20, "within the room"
    expected, seen = np.transpose(evidence.cells)[2:]
    assert 0 == seen.sum() < expected.sum() <= report.landmarks_expected
    assert len(encode_message(report)) - len(encode_message(msgspec.structs.replace(report, evidence=None))) <= 200
    assert [picture.kind for picture in report.thumbnails] == ["frame", "frame", "frame", "matches"]
    map_from_cam = report.map_from_base.target_from_source @ report.camera.base_from_cam.target_from_source
    np.testing.assert_allclose(map_from_cam, told.onset.belief.map_from_body @ rig.body_from_cam, atol=1e-9)
    belief = told.onset.belief._replace(floor="hall-2")
    onset = told.onset._replace(belief=belief)
    other = failure_report(told._replace(onset=onset, unmatched=onset), profile, report_id="ab" * 16, wall_ns=7)
    assert (other.map_from_base, other.tile, other.landmarks_expected) == (None, None, None), "no place on this site"
    assert report.camera.size_px == (rig.camera.width_px, rig.camera.height_px)
    lens = rig.camera.cx_px, rig.camera.cy_px, rig.camera.focal_px
    assert (*report.camera.centre_px, report.camera.focal_px) == lens
    assert len(encode_message(report.camera)) < 256
    assert len(encode_message(report)) < MAX_MESSAGE_BYTES / 4
    left = frame(60).left
    bright = told._replace(unmatched=told.unmatched._replace(left=left))
    sharp, blurred = (
        failure_report(bright, profile._replace(pictures=seen), report_id="ab" * 16, wall_ns=7).thumbnails
        for seen in ("full", "blurred")
    )
    assert [each.stamp_ns for each in blurred] == [each.stamp_ns for each in sharp]
    edges = [cv2.Laplacian(grey(each[0].jpeg), cv2.CV_64F).var() for each in (sharp, blurred)]
    assert edges[1] < 0.1 * edges[0]
    assert is_like(sharp[3].jpeg, left, without_detail(left))
    assert is_like(blurred[3].jpeg, without_detail(left), left)
    assert LocclientConfig().run.replays == profile.pictures == "blurred", "unless somebody asks for more"
    unseen = failure_report(bright, profile._replace(pictures="off"), report_id="ab" * 16, wall_ns=7)
    assert b"\xff\xd8\xff" not in encode_message(unseen), "the beginning of a JPEG"
    assert (unseen.thumbnails, unseen.landmarks_expected) == ((), report.landmarks_expected)
    written = json.loads(write_failure(tmp_path / "failures", report).read_text())
    assert written["cause"] == "dark"
    assert all((tmp_path / "failures" / name).stat().st_size > 100 for name in written["thumbnails"])


@pytest.mark.parametrize("period", [0.7, 1.3, 1.7])
@pytest.mark.parametrize("width_px", [240, 320, 640])
def test_many_blurred_pictures_show_no_more_than_one(width_px: int, period: float) -> None:
    """Stripes finer than two of the 32 pixels leave no trace, wherever they lie: frames of a moving camera cannot be put together."""
    columns = np.arange(width_px) / (width_px / 32)
    shown = [128.0 + 100.0 * np.sin(2.0 * np.pi * (columns / period + shift)) for shift in np.linspace(0.0, 1.0, 20)]
    blurred = [without_detail(np.tile(each.astype(np.uint8), (width_px // 2, 1))) for each in shown]
    middle = np.array(blurred)[:, width_px // 4, width_px // 5 : -width_px // 5].astype(float)
    assert np.ptp(middle, axis=0).max() <= 2.0, "grey levels, of rounding"
