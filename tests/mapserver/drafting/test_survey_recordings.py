"""Recordings of a build: opened once, and their frames decoded once."""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.errors import RecordingError, SurveyError
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings import image_series as series
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet
from mapserver.drafting import mapped_images, survey_recordings
from mapserver.drafting.admission import CheckedRecording
from mapserver.drafting.survey_recordings import (
    Admission,
    BegunSurvey,
    OpenRecordings,
    RecordingOptions,
    RecordingSurvey,
    survey_recording,
)
from mapserver.quality.figures import Evidence, RigEvidence, pair_yaws
from mapserver.survey import stages
from mapserver.survey.bundle.stereo_yaw_check import StereoYaw, disparity_shift
from mapserver.survey.loops.loops import Loops
from mapserver.survey.odometry_pass import parts_between_lifts
from mapserver.survey.rig import Rig
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Landmarks
from mapserver.survey.survey_inputs import AdjustedChain, SurveyConfig, SurveyTools
from support.recordings.recording_samples import make_sample, write_mcap
from support.worlds.pinhole_pair import CAMERA


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("recordings") / "turn", make_sample(8))


@pytest.mark.parametrize(("has_room", "decodings"), [(True, 8), (False, 12)])
def test_frames_are_decoded_once(drive: Path, tmp_path: Path, monkeypatch, has_room: bool, decodings: int) -> None:
    found: list[int] = []
    decode = series.decode_frame
    monkeypatch.setattr(series, "decode_frame", lambda stored: (found.append(stored.stamp_ns), decode(stored))[1])
    if not has_room:
        monkeypatch.setattr(
            mapped_images.os, "posix_fallocate", Mock(side_effect=OSError(28, "No space left on device"))
        )
    with open_recording(drive) as plain:
        expected = [plain.read_frame(n) for n in range(8)]
    with OpenRecordings(RecordingOptions(), tmp_path) as reading:
        with reading.open(drive) as (first, indices):
            found.clear()
            assert [first.read_frame(n).stamp_ns for n in (2, 5, 2)] == [expected[n].stamp_ns for n in (2, 5, 2)]
        with reading.open(drive) as (second, _):
            assert second is first
            frames = [second.read_frame(int(n)) for n in (*indices, 0)]
    for own, theirs in zip(frames, expected, strict=False):
        np.testing.assert_array_equal(own.left, theirs.left)
        np.testing.assert_array_equal(own.right, theirs.right)
    assert len(found) == decodings
    assert list(tmp_path.iterdir()) == []


def test_another_recording_closes_the_one_before(drive: Path, tmp_path: Path, monkeypatch) -> None:
    other = write_mcap(tmp_path / "other", make_sample(4))
    closed: list[int] = []
    close = Recording.close
    monkeypatch.setattr(Recording, "close", lambda self: (closed.append(len(self)), close(self)))
    with OpenRecordings(RecordingOptions(), tmp_path) as reading:
        for path, count in ((drive, 8), (other, 4), (drive, 8)):
            with reading.open(path) as (recording, _):
                assert len(recording) == count
        assert closed == [8, 4]
    assert closed == [8, 4, 8]


def test_a_recording_that_cannot_be_used_is_closed(drive: Path, tmp_path: Path, monkeypatch) -> None:
    closed: list[int] = []
    monkeypatch.setattr(Recording, "close", lambda self: closed.append(len(self)))
    with (
        pytest.raises(RecordingError, match="cannot be used as rgbd"),
        OpenRecordings(RecordingOptions(use=SensorSet.RGBD), tmp_path) as reading,
        reading.open(drive),
    ):
        pass
    assert closed == [8]


def unwatched(_: object) -> None:
    pass


def test_a_survey_goes_on_from_what_was_followed_under_its_calibration(
    drive: Path, tmp_path: Path, monkeypatch
) -> None:
    """And from nothing else: a calibration that was tried on the way, or given before a correction, is not the survey's.

    The pictures of one that was tried do not fill the build's file.
    """
    begin = Mock(side_effect=lambda inputs, settings, tools: [tools.images])
    monkeypatch.setattr(survey_recordings, "begin_survey", begin)
    monkeypatch.setattr(survey_recordings, "busiest_stretch", lambda chain, *_: chain)
    with open_recording(drive) as recording, mapped_images.MappedImageStore(tmp_path) as images:
        begun = BegunSurvey(recording, np.arange(8), SurveySettings(), SurveyTools(images=images))
        given = recording.calibration
        tried, corrected = replace(given), replace(given)
        chain_of = partial(begun.chain_of, has_wheels=len(recording.wheel) > 0)
        assert chain_of(given) is None
        first = begun(recording, given, unwatched)
        assert begun(recording, tried, unwatched) != [images]
        assert [chain_of(rig) for rig in (given, tried, corrected)] == [first, None, None]
        second = begun(replace(recording, calibration=corrected), corrected, unwatched)
        assert [chain_of(rig) for rig in (given, corrected)] == [None, second]
        assert begun.chain_of(corrected, has_wheels=len(recording.wheel) == 0) is None
        assert first == second == [images]
        long = replace(recording, frame_stamps_ns=np.arange(8, dtype=np.int64) * 20_000_000_000)
        begun(long, tried, unwatched)
        begun(long, given, unwatched)
        frames = [call.args[0].frame_count for call in begin.call_args_list]
        assert frames == [8, 8, 8, 2, 8]  # what is tried for a long drive is its busiest half minute


@pytest.mark.parametrize(
    ("lifted", "parts"),
    [
        ((), [(None, None)]),
        ((40, 41, 50), [(0, 36), (51, 100)]),  # what it noticed within 0.4 s began before, and hands held it in between
        ((2, 97), [(3, 93)]),
        (range(100), []),
    ],
)
def test_a_recording_ends_where_its_robot_is_lifted(
    lifted: Sequence[int], parts: list[tuple[int | None, int | None]]
) -> None:
    estimates: Any = [SimpleNamespace(stamp_ns=100_000_000 * n, is_lifted=n in lifted) for n in range(100)]
    assert [(part.start, part.stop) for part in parts_between_lifts(estimates)] == parts


def test_nobody_holds_what_was_begun_once_its_loops_are_closed(drive: Path, tmp_path: Path, monkeypatch) -> None:
    """Its landmarks are as large as those that are made anew then."""

    @dataclass
    class State:
        rig: object
        landmarks: Landmarks = Landmarks.empty()  # noqa: RUF009 -- it is not changed
        map_from_body: object = None
        stamps_ns: tuple[int, ...] = ()

    def adjust(*_: object) -> None:
        raise SurveyError("held" if begun() else "let go of")

    with open_recording(drive) as recording:
        rig, camera = recording.calibration, Rectifier(recording.calibration).camera
    single: Any = Rig.of_one(camera, np.eye(4))
    state: Any = State(single)
    parts: Any = SimpleNamespace(keyframes=[], estimates=[]), state, set(), object()
    chain = AdjustedChain(*parts)
    admitted = [Admission(CheckedRecording(rig, [], RigEvidence("", [], {}, {}), {}), begun=chain)]
    begun = weakref.ref(state)
    del chain, parts, state
    monkeypatch.setattr(stages, "close_loops", lambda *_: (State(single), Loops()))
    monkeypatch.setattr(stages, "match_again", adjust)
    config, reading = SurveyConfig(SurveySettings(), default_vocabulary()), OpenRecordings(RecordingOptions(), tmp_path)
    with pytest.raises(SurveyError, match="let go of"):
        survey_recording(drive, admitted.pop(), reading, None, config, SurveyTools())


def test_the_turn_within_each_pair_of_a_rig_is_told_and_judged() -> None:
    """Robots measure depth with the same error by every view."""
    straight, turned = StereoYaw(0.01, 0.05, corrected=False), StereoYaw(-2.0, 0.05, corrected=True)
    state: Any = SimpleNamespace(rig=Rig.of_one(CAMERA, np.eye(4)), priors=())
    for yaws, words in (
        ((straight, turned), "+2.00 px of view 1"),
        ((turned, turned), "+2.00 px and +2.00 px of view 1"),
    ):
        survey: Any = SimpleNamespace(stereo_yaws=yaws, odometry=SimpleNamespace(cuts=()), components=(), state=state)
        nothing: Any = None
        rest = nothing, RigEvidence("", [], {}, {}), {}, []
        surveyed = RecordingSurvey(nothing, nothing, nothing, (), nothing, survey, nothing, (), *rest)
        assert len(surveyed.remarks()) == sum(yaw.corrected for yaw in yaws)
        assert "disparities of view 1 by +2.00 px" in surveyed.remarks()[-1]
        assert words in surveyed.evidence().doubted["pair geometry"]


def test_what_cannot_judge_its_pair_takes_the_turn_by_an_earlier_survey(monkeypatch) -> None:
    """The earlier one is kept by what judged its pair alone, the surest counts, and one that may be chance changes nothing."""
    nothing: Any = None
    marks = replace(Landmarks.empty(), obs_pixels=np.zeros((1, 3)), obs_camera=np.zeros(1, np.int64))
    state: Any = SimpleNamespace(rig=Rig.of_one(CAMERA, np.eye(4)), priors=(), landmarks=marks)
    survey: Any = SimpleNamespace(stereo_yaws=(StereoYaw(0.2, 0.05, corrected=True),), state=state)
    found, lacking = [], RigEvidence("a", not_judged={"pair geometry": "turn"})
    judging = RigEvidence("a", ["pair geometry"])
    for evidence, corrections in ((judging, {}), (lacking, {}), (lacking, {"pair yaw": 1e-3})):
        rest = nothing, evidence, corrections, []
        found.append(RecordingSurvey(nothing, nothing, nothing, (), nothing, survey, nothing, (), *rest).evidence())
        lacks = CheckedRecording(nothing, [], evidence, corrections).lacks_pair
        assert (found[-1].pair_yaw is None, lacks) == (evidence is lacking, evidence is lacking and not corrections)
    vague, chance = RigEvidence("a", pair_yaw=(0.1, 0.01)), RigEvidence("b", pair_yaw=(1e-5, 1e-4))
    yaws = pair_yaws([None, Evidence(calibrations=[vague, *found]), Evidence(calibrations=[chance])], 3.0)
    assert yaws == {"a": pytest.approx((0.2 / CAMERA.focal_px, 0.05 / CAMERA.focal_px))}
    own = (StereoYaw(-0.05, 0.03, corrected=False),)
    for name, result in (("_stereo_yaws", own), ("_posed", state), ("refine_observations", marks)):
        monkeypatch.setattr(stages, name, lambda *_, result=result: result)
    monkeypatch.setattr(stages, "_adjusted", lambda state, *_: state)
    monkeypatch.setattr(stages, "replace", lambda _, landmarks: landmarks)
    first: Any = SimpleNamespace(state=state, redundant=None, odometry=nothing, depths=None, map_from_cam=None)
    for earlier, shift_px in ((None, 0.0), (yaws["a"], 0.2)):
        _, adjusted, taken = stages.refine(first, SurveySettings(), SurveyTools(), earlier)
        np.testing.assert_allclose(adjusted.obs_pixels[:, 2], shift_px * disparity_shift(CAMERA, marks.obs_pixels))  # type: ignore[attr-defined]
        assert (taken[0].is_earlier, taken[0].corrected) == (bool(shift_px), bool(shift_px))


@pytest.mark.parametrize(
    ("frames", "hz", "chosen", "suits"),
    [
        (600, 20.0, slice(None), True),
        (600, 20.0, slice(300), False),  # 15 s of it, where its busiest 30 s say more
        (1200, 20.0, slice(700), True),
        (1200, 20.0, slice(None, None, 2), False),
        (1300, 10.0, slice(None), True),  # over two minutes
        (1, 20.0, slice(None), True),
    ],
)
def test_a_drive_without_gaps_is_followed_as_a_whole(
    drive: Path, frames: int, hz: float, chosen: slice, suits: bool
) -> None:
    with open_recording(drive) as recording:
        stamps_ns = (np.arange(frames) * 1e9 / hz).astype(np.int64)
        assert BegunSurvey.suits(replace(recording, frame_stamps_ns=stamps_ns), np.arange(frames)[chosen]) is suits
