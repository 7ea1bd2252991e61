"""Markers as priors: right within their covariance, told once, and named where they stand elsewhere than listed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleetmap.encoding import to_json
from fleetmap.errors import UsageError
from fleetmap.geometry import Array, se3, se3_inverse
from fleetmap.messages import Placement, Status
from fleetmap.plugins.markers import Marker, MarkerList, read_markers
from fleetmap.sensors.rectification import MountedCamera, RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.place import boxminus
from locclient.plugins.markers import PRIORS, MarkerPriors, MarkersSection
from support.fleet.estimates import estimate as estimate_at
from support.painted_markers import facing, painted

CAMERA = StereoCamera(420.0, 320.0, 240.0, 0.1, 640, 480)
BODY_FROM_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.2, 0.05, 0.1]))
BASE_FROM_BODY = se3(np.eye(3), np.array([0.1, 0.0, 0.4]))
AT = se3(np.eye(3), np.array([20.0, 8.0, 0.3]))  # map_from_body
SIZE_M = 0.2
NOWHERE = '{"position_m": [0, 0, 0], "quat_wxyz": [0, 0, 0, 0]}'


def listed(*, moved_m: Array | None = None) -> tuple[MarkerList, dict[int, Array]]:
    """Two markers before the robot, as listed and as they are; the first one moved from where it is listed."""
    there = {3: facing(np.array([22.2, 8.3, 0.9]), np.pi + 0.5), 4: facing(np.array([23.4, 7.2, 0.7]), np.pi - 0.3)}
    places = {number: Placement.of(at) for number, at in there.items()}
    markers = (Marker(id=n, size_m=SIZE_M, map_from_marker=p, sigma_m=0.01) for n, p in places.items())
    known = MarkerList(markers=tuple(markers))
    if moved_m is not None:
        there[3] = se3(np.eye(3), moved_m) @ there[3]
    return known, there


def frame(number: int, there: dict[int, Array]) -> RectifiedFrame:
    rng = np.random.default_rng(number)
    picture = painted(CAMERA, AT @ BODY_FROM_CAM, there, SIZE_M, rng)
    return RectifiedFrame(number * 600_000_000, picture, None, None)


def priors_of(known: MarkerList) -> MarkerPriors:
    return MarkerPriors(known, MountedCamera(CAMERA, BODY_FROM_CAM), BASE_FROM_BODY)


def is_within(told: PositionPrior) -> bool:
    """By its covariance, six degrees of freedom."""
    error = boxminus(told.map_from_base, AT @ se3_inverse(BASE_FROM_BODY))
    return bool(error @ np.linalg.solve(told.cov_rot_trans, error) < 22.5)


def test_a_marker_tells_the_place_within_its_covariance_and_once() -> None:
    known, there = listed()
    for number in range(12):
        source = priors_of(known)
        (told,) = source.priors(frame(number, there))
        assert told.is_revisable and told.floor == ""
        assert is_within(told)
        sigma_m = np.sqrt(np.linalg.eigvalsh(told.cov_rot_trans[3:5, 3:5])[-1])
        assert sigma_m < 0.6, "tight enough for one fix to confirm"
        (other,) = source.priors(frame(number + 20, there))
        assert not np.allclose(other.map_from_base, told.map_from_base), "by the other marker"
        assert source.priors(frame(number + 40, there)) == [], "both have told it"


def test_a_number_that_is_seen_twice_tells_nothing() -> None:
    known, there = listed()
    pictures = [frame(0, {3: there[n]}).left for n in (3, 4)]
    twice = np.maximum(*pictures)
    left = np.where(np.abs(twice - 120.0) > 30, twice, np.minimum(*pictures))
    assert priors_of(known).priors(RectifiedFrame(0, left.astype(np.uint8), None, None)) == []


def test_a_moved_marker_is_named_until_it_agrees() -> None:
    known, there = listed(moved_m=np.array([0.0, 0.4, 0.0]))
    source = priors_of(known)
    truth, words = replace(estimate_at(0.0, sigma_m=0.02), map_from_body=AT), []
    for number in range(6):
        source.priors(frame(number, there))
        words.append(source.judge(truth))
    assert words[:4] == [""] * 4 and "listed: 3;" in words[4]
    source.judge(replace(truth, status=Status.LOST, map_from_body=None))
    (told,) = source.priors(frame(7, there))
    assert is_within(told), "by the other"
    source.judge(truth)
    source.priors(frame(8, listed()[1]))
    assert source.judge(truth) == "", "put back"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "no list of markers"),
        ('{"markers": [], "dictionary": "7X7"}', "unknown dictionary"),
        ('{"markers": [{"id": 1, "size_m": 0, "map_from_marker": {}}]}', "no list of markers"),
        (f'{{"markers": [{{"id": 1, "size_m": 1, "map_from_marker": {NOWHERE}}}]}}', "unit quaternion"),
    ],
)
def test_a_wrong_list_is_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "markers.json"
    file.write_text(text)
    with pytest.raises(UsageError, match=words):
        PRIORS.open(MarkersSection(file=str(file)), MountedCamera(CAMERA, BODY_FROM_CAM), BASE_FROM_BODY)


def test_a_list_comes_back_and_without_one_nothing_is_looked_for(tmp_path: Path) -> None:
    known, _ = listed()
    (tmp_path / "markers.json").write_bytes(to_json(known))
    assert read_markers(tmp_path / "markers.json") == known
    assert PRIORS.open(MarkersSection(), MountedCamera(CAMERA, BODY_FROM_CAM), BASE_FROM_BODY) is None
