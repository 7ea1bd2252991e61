"""Archives keep a survey to the bit."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import MapFormatError
from fleetmap.mapformat.container import pack
from mapserver.store.archive import decode_archive, encode_archive
from support.storage.map_samples import random_survey

HISTORY = ("keyframe_ids", "is_place", "landmark_expected", "landmark_seen", "landmark_missed")


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
    np.testing.assert_array_equal(back.history.keyframe_ids, np.arange(6))
    assert back.history.is_place.all()
    assert (back.history.next_keyframe_id, back.history.next_landmark_id) == (6, survey.landmark_ids.max() + 1)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("obs_keyframe", lambda values: np.full_like(values, 1 << 30)),
        ("obs_landmark", lambda values: np.full_like(values, -1)),
        ("obs_octave", lambda values: np.full_like(values, -128)),
        ("points_map", lambda values: values[:5]),
        ("descriptors", lambda values: values[:, :1]),
    ],
)
def test_arrays_that_do_not_fit_each_other_are_refused(name: str, change: Callable[[Any], Any]) -> None:
    survey = random_survey(np.random.default_rng(0))
    with pytest.raises(MapFormatError, match=r"archive: .*; it is damaged"):
        decode_archive(encode_archive(replace(survey, **{name: change(getattr(survey, name))})))


def test_damaged_archives_are_refused() -> None:
    data = encode_archive(random_survey(np.random.default_rng(0), keyframes=2, landmarks=8))
    for position in range(0, len(data), 37):
        damaged = bytearray(data)
        damaged[position] ^= 0xFF
        with pytest.raises(MapFormatError):
            decode_archive(bytes(damaged))
    for payload in (b"", b"\xff\xff\xff\xff{}", b"\x02\0\0\0{}"):
        with pytest.raises(MapFormatError):
            decode_archive(pack(b"FMAR", 2, payload))


def test_an_archive_takes_memory_in_proportion_to_its_bytes() -> None:
    """Zeros shrink a thousandfold: what claims to is refused before it is unpacked."""
    with pytest.raises(MapFormatError, match="declares 200000000 bytes"):
        decode_archive(pack(b"FMAR", 2, bytes(200_000_000), level=1))
