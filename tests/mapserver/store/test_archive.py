"""Archives keep a survey to the bit."""

from dataclasses import fields

import numpy as np
import pytest

from fleetmap.errors import MapFormatError, NewerFormatError
from fleetmap.mapformat import pack
from map_samples import random_survey
from mapserver.store.archive import decode_archive, encode_archive


def test_round_trip_is_exact_and_deterministic() -> None:
    survey = random_survey(np.random.default_rng(0))
    survey.obs_pixels[::3, 2] = np.nan
    data = encode_archive(survey)
    back = decode_archive(data)
    assert encode_archive(back) == data
    for field in fields(survey):
        mine, theirs = getattr(survey, field.name), getattr(back, field.name)
        if isinstance(mine, np.ndarray):
            assert mine.dtype == theirs.dtype
            np.testing.assert_array_equal(mine, theirs)
    assert back.camera == survey.camera
    np.testing.assert_array_equal(back.trajectory.stamps_ns, survey.trajectory.stamps_ns)
    np.testing.assert_array_equal(back.trajectory.frame_from_body, survey.trajectory.frame_from_body)
    assert back.points_map.flags.writeable
    assert back.history is not None
    np.testing.assert_array_equal(back.history.keyframe_ids, np.arange(6))
    assert back.history.is_place.all()
    assert (back.history.next_keyframe_id, back.history.next_landmark_id) == (6, survey.landmark_ids.max() + 1)


def test_damaged_archives_are_refused() -> None:
    data = encode_archive(random_survey(np.random.default_rng(0), keyframes=2, landmarks=8))
    for position in range(0, len(data), 37):
        damaged = bytearray(data)
        damaged[position] ^= 0xFF
        with pytest.raises(MapFormatError):
            decode_archive(bytes(damaged))
    with pytest.raises(NewerFormatError, match="format 3"):
        decode_archive(pack(b"FMAR", 3, b""))
    for payload in (b"", b"\xff\xff\xff\xff{}", b"\x02\0\0\0{}"):
        with pytest.raises(MapFormatError):
            decode_archive(pack(b"FMAR", 1, payload))
