"""Recordings of a build: opened once, and frames of the examination decoded once."""

from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings import image_series as series
from fleetmap.sensors.samples import SensorSet
from mapserver.drafting import mapped_images
from mapserver.drafting.survey_recordings import (
    OpenRecordings,
    RecordingOptions,
)
from support.recordings.recording_samples import make_sample, write_euroc


@pytest.fixture(scope="module")
def euroc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("recordings") / "turn", make_sample(8))


@pytest.mark.parametrize(("has_room", "decodings"), [(True, 9), (False, 12)])
def test_frames_of_the_first_use_are_decoded_once(
    euroc: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_room: bool, decodings: int
) -> None:
    found: list[int] = []
    decode = series.decode_frame
    monkeypatch.setattr(series, "decode_frame", lambda stored: (found.append(stored.stamp_ns), decode(stored))[1])
    if not has_room:
        monkeypatch.setattr(mapped_images.os, "posix_fallocate", full)
    with open_recording(euroc) as plain:
        expected = [plain.read_frame(n) for n in range(8)]
    with OpenRecordings(RecordingOptions(), tmp_path) as reading:
        with reading.open(euroc) as (first, indices):
            found.clear()
            assert [first.read_frame(n).stamp_ns for n in (2, 5, 2)] == [expected[n].stamp_ns for n in (2, 5, 2)]
        with reading.open(euroc) as (second, _):
            assert second is first
            frames = [second.read_frame(int(n)) for n in (*indices, 0)]
    for own, theirs in zip(frames, expected, strict=False):
        np.testing.assert_array_equal(own.left, theirs.left)
        np.testing.assert_array_equal(own.right, theirs.right)
    assert len(found) == decodings
    assert list(tmp_path.iterdir()) == []


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_another_recording_closes_the_one_before(euroc: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = write_euroc(tmp_path / "other", make_sample(4))
    closed: list[int] = []
    close = Recording.close
    monkeypatch.setattr(Recording, "close", lambda self: (closed.append(len(self)), close(self)))
    with OpenRecordings(RecordingOptions(), tmp_path) as reading:
        for path, count in ((euroc, 8), (other, 4), (euroc, 8)):
            with reading.open(path) as (recording, _):
                assert len(recording) == count
        assert closed == [8, 4]
    assert closed == [8, 4, 8]


def test_a_recording_that_cannot_be_used_is_closed(
    euroc: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[int] = []
    monkeypatch.setattr(Recording, "close", lambda self: closed.append(len(self)))
    with (
        pytest.raises(RecordingError, match="cannot be used as rgbd"),
        OpenRecordings(RecordingOptions(use=SensorSet.RGBD), tmp_path) as reading,
        reading.open(euroc),
    ):
        pass
    assert closed == [8]
