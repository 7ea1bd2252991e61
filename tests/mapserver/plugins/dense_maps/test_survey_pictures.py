"""Pictures of surveys: some of the path, replaced by later ones of the same view, bounded in bytes, and told where they are missing."""

import msgspec
import numpy as np
import pytest

from fleetmap.errors import MapFormatError, NewerFormatError, StateError
from fleetmap.geometry import se3, so3_exp
from fleetmap.mapformat.names import sha256_hex
from fleetmap.sensors.rectification import RectifiedFrame
from mapserver.plugins.dense_maps.survey_pictures import kept_pictures, nearest_pictures
from mapserver.store import MapStore
from mapserver.store.survey_pictures import PICTURES_KEY, PictureIndex, SurveyPicture, pictures_of
from support.storage.dense_samples import save_session_pictures
from support.storage.map_samples import save_sample_draft
from support.storage.room_sessions import Seen, session_at


def along(length_m: float, *, yaw: float = 0.0, y: float = 0.0):
    """Frames each 0.6 m along x that look ahead."""
    turn = so3_exp(np.array([0.0, 0.0, yaw]))
    return session_at([se3(turn, np.array([x, y, 0.5])) for x in np.arange(0.0, length_m, 0.6)], has_depth=True)


def index_of(blobs: list[bytes]) -> tuple[SurveyPicture, ...]:
    return msgspec.json.decode(blobs[0], type=PictureIndex).pictures


def test_a_picture_each_two_metres_is_kept_within_ten_kilobytes_a_metre() -> None:
    session, rng = along(9.0), np.random.default_rng(0)
    for number in (0, 8):  # noise fills any JPEG
        noise = rng.integers(0, 256, (480, 640), np.uint8)
        session.survey.odometry.keyframes[number] = Seen(RectifiedFrame(number, noise, None, None), number)
    blobs, report = kept_pictures([session], (), {}.__getitem__, 7)
    found = index_of(blobs)
    np.testing.assert_allclose(np.diff([one.place_map_m[0] for one in found]), 2.4, atol=1e-3)
    assert (report.pictures, report.sha256, report.bytes) == (4, sha256_hex(blobs[0]), sum(map(len, blobs)))
    assert max(map(len, blobs[1:])) <= 20_000
    assert {sha256_hex(data) for data in blobs[1:]} == {one.sha256 for one in found}
    assert kept_pictures([session], (), {}.__getitem__, 7) == (blobs, report)
    assert kept_pictures([], (), {}.__getitem__, 7) == ([], None)


def test_a_later_drive_replaces_what_it_saw_the_same_way() -> None:
    first, _ = kept_pictures([along(9.0)], (), {}.__getitem__, 7)
    kept = {sha256_hex(data): data for data in first}
    for session, left in ((along(3.0), 2), (along(9.0, yaw=np.pi), 4), (along(9.0, y=3.0), 4), (along(9.0, y=1.0), 0)):
        later, _ = kept_pictures([session._replace(name="later")], index_of(first), kept.__getitem__, 8)
        assert len(set(index_of(later)) & set(index_of(first))) == left
        assert {sha256_hex(data) for data in later[1:]} >= {one.sha256 for one in index_of(later)}


def test_those_that_look_elsewhere_come_last() -> None:
    ahead, back = (index_of(kept_pictures([along(9.0, yaw=yaw)], (), {}.__getitem__, 7)[0]) for yaw in (0.0, np.pi))
    place, looks = np.array([4.0, 0.0, 0.5]), np.array(back[0].looks_map)
    found = nearest_pictures((*ahead, *back), place, looks)
    by_distance = sorted(back, key=lambda one: np.linalg.norm(np.subtract(one.place_map_m, place)))
    assert [one for one, _ in found[:4]] == by_distance
    assert found[0][1] < 1.5


def test_a_version_without_pictures_and_damaged_ones_are_told(store: MapStore) -> None:
    old = store.manifest("lab", save_sample_draft(store))
    manifest = store.manifest("lab", save_session_pictures(store, [along(9.0)]))
    assert len(pictures_of(manifest, store.blob)) == 4
    assert store.verify().faults == []
    assert store.served_kind(manifest.report[PICTURES_KEY]["sha256"]) is None, "robots never get them"
    with pytest.raises(StateError, match="built without `survey_pictures`"):
        pictures_of(old, {}.__getitem__)
    with pytest.raises(MapFormatError, match="index of pictures"):
        pictures_of(manifest, lambda _: b"{}[")
    with pytest.raises(NewerFormatError, match="format 2"):
        pictures_of(manifest, lambda _: b'{"format_version":2}')
