"""Recordings of a build: opened once, and frames of the examination decoded once."""

from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings import image_series as series
from fleetmap.recordings.images import StoredFrame
from fleetmap.sensors.samples import CameraFrame, SensorSet
from mapserver.build import image_spill
from mapserver.build.survey_recordings import OpenRecordings, RecordingOptions
from support.recordings.recording_samples import make_sample, write_euroc


@pytest.fixture(scope="module")
def euroc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("recordings") / "turn", make_sample(8))


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Stamps of the frames that were decoded, in their order."""
    found: list[int] = []
    decode = series.decode_frame

    def noted(stored: StoredFrame) -> CameraFrame:
        found.append(stored.stamp_ns)
        return decode(stored)

    monkeypatch.setattr(series, "decode_frame", noted)
    return found


def same(frame: CameraFrame, other: CameraFrame) -> bool:
    assert frame.right is not None and other.right is not None
    return np.array_equal(frame.left, other.left) and np.array_equal(frame.right, other.right)


def test_frames_of_the_first_use_are_decoded_once(euroc: Path, tmp_path: Path, decoded: list[int]) -> None:
    with open_recording(euroc) as plain:
        expected = [plain.read_frame(n) for n in range(8)]
    with OpenRecordings(RecordingOptions(), tmp_path / "store" / "not yet") as reading:
        with reading.open(euroc) as (first, indices):
            decoded.clear()
            assert [first.read_frame(n).stamp_ns for n in (2, 5, 2)] == [expected[n].stamp_ns for n in (2, 5, 2)]
            assert len(decoded) == 2
        with reading.open(euroc) as (second, _):
            assert second is first
            frames = [second.read_frame(int(n)) for n in (*indices, 0)]
        assert all(same(own, theirs) for own, theirs in zip(frames, expected, strict=False))
        assert frames[2].left.flags.writeable
        assert decoded == [expected[n].stamp_ns for n in (2, 5, 0, 1, 3, 4, 6, 7, 0)]
    assert list(tmp_path.iterdir()) == []


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


def test_without_room_frames_are_decoded_again(
    euroc: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, decoded: list[int]
) -> None:
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(image_spill.os, "pwrite", full)
    with OpenRecordings(RecordingOptions(), tmp_path) as reading, reading.open(euroc) as (recording, _):
        decoded.clear()
        assert same(recording.read_frame(1), recording.read_frame(1))
        assert len(decoded) == 2
