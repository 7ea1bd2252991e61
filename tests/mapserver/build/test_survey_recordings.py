"""Recordings of a build: opened once, and frames of the examination decoded once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from fleetmap.bow import decode_vocabulary
from fleetmap.bow.shipped_vocabulary import default_vocabulary_bytes
from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings import image_series as series
from fleetmap.recordings.images import StoredFrame
from fleetmap.sensors.samples import CameraFrame, SensorSet
from mapserver.build import image_spill, survey_beginnings, survey_recordings
from mapserver.build.admission import CheckedRecording, rig_evidence
from mapserver.build.survey_beginnings import SurveyBeginnings
from mapserver.build.survey_recordings import (
    Admission,
    OpenRecordings,
    RecordingOptions,
    admit_recordings,
    survey_recording,
)
from mapserver.build.worker import open_executor, open_side_process
from mapserver.calibration.recordings import Follow
from mapserver.doctor import Finding, Verdict
from mapserver.store.archive import encode_archive
from mapserver.survey.chain import AdjustedChain
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.pipeline import Survey
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyConfig, SurveyTools
from support.recordings.recording_samples import make_sample, write_euroc

OPTIONS = SurveyConfig(SurveySettings(), decode_vocabulary(default_vocabulary_bytes()))


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


def admitted(path: Path, reading: OpenRecordings | RecordingOptions, executor: Executor = SERIAL) -> Admission:
    """As a build of this recording alone admits it."""
    beginnings = SurveyBeginnings(OPTIONS, SurveyTools(executor=executor))
    return admit_recordings([path], reading, Console(quiet=True), needs_truth=False, beginnings=beginnings)[path]


def test_a_survey_goes_on_from_its_examination_to_the_same_map(tmp_path: Path) -> None:
    path = write_euroc(tmp_path / "turn", make_sample(24))
    with OpenRecordings(RecordingOptions(), tmp_path) as reading:
        admission = admitted(path, reading)
        assert admission.begun is not None
        assert admission.begun.rig is admission.rig
        maps = [
            encode_archive(survey_recording(path, each, reading, None, OPTIONS, SurveyTools()).survey.map)
            for each in (admission, replace(admission, begun=None))
        ]
    assert maps[0] == maps[1]


def test_a_survey_is_finished_beside_its_examination_to_the_same_map(tmp_path: Path) -> None:
    path = write_euroc(tmp_path / "turn", make_sample(24))
    made = []
    for threads in (1, 2):
        with (
            open_side_process(threads) as side,
            open_executor(threads, None, side) as executor,
            OpenRecordings(RecordingOptions(), tmp_path) as reading,
        ):
            admission = admitted(path, reading, executor)
            assert admission.begun is not None
            assert (admission.begun.done is not None) == (threads > 1)
            made.append(survey_recording(path, admission, reading, None, OPTIONS, SurveyTools(executor=executor)))
    (alone, beside), held_out = made, [[(h.number, h.features.pixels.tobytes()) for h in m.held_out] for m in made]
    assert encode_archive(alone.survey.map) == encode_archive(beside.survey.map)
    assert (alone.findings, alone.calibration) == (beside.findings, beside.calibration)
    assert held_out[0] == held_out[1] != []


def test_a_survey_whose_calibration_is_wrong_is_not_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_euroc(tmp_path / "turn", make_sample(24))
    bad = Finding("baseline", Verdict.WARN, 0.01, "", "1 % too long")
    monkeypatch.setattr(survey_beginnings, "findings_of", lambda *_: [bad])
    finish, stopped = survey_beginnings.finish_survey, list[str]()

    def finished(chain: AdjustedChain, config: SurveyConfig, tools: SurveyTools) -> Survey:
        with pytest.raises(survey_beginnings._InVainError):
            while True:  # until the estimate is there
                tools.progress("loops", 0, 1)
        stopped.append("loops")
        return finish(chain, config, tools)

    monkeypatch.setattr(survey_beginnings, "finish_survey", finished)
    with open_side_process(2) as side, open_executor(2, None, side) as executor:
        admission = admitted(path, RecordingOptions(), executor)
    assert stopped == ["loops"]
    assert admission.begun is not None
    assert admission.begun.done is None


def test_a_survey_under_another_calibration_does_not_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_euroc(tmp_path / "turn", make_sample(24))
    followed: list[int] = []

    def corrected(recording: Recording, *, follow: Follow, **_: object) -> CheckedRecording:
        followed.append(follow(recording).result().keyframes)
        other = replace(recording.calibration, base_from_body=np.eye(4))
        return CheckedRecording(other, [], rig_evidence("", []), {})

    monkeypatch.setattr(survey_recordings, "checked", corrected)
    assert admitted(path, RecordingOptions()).begun is None
    assert followed[0] >= 2


def test_nothing_is_begun_that_may_be_in_vain(euroc: Path) -> None:
    beginnings, indices = SurveyBeginnings(OPTIONS, SurveyTools()), np.arange(8)
    with open_recording(euroc) as recording:
        assert beginnings.follow(recording, indices, is_given=False) is not None
        stamps_ns = recording.frame_stamps_ns
        assert beginnings.follow(recording, indices, is_given=True) is None
        slow = replace(recording, frame_stamps_ns=stamps_ns[0] + 1000 * (stamps_ns - stamps_ns[0]))
        assert beginnings.follow(slow, indices, is_given=False) is None
        assert SurveyBeginnings(None, SurveyTools()).follow(recording, indices, is_given=False) is None
