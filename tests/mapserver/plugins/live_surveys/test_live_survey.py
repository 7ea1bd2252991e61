"""A survey under way from end to end, on a small recording."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.errors import FleetmapError, UsageError
from fleetmap.messages import MAX_MESSAGE_BYTES, encode_message
from fleetmap.recordings import Topics, open_recording
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet
from fleetmap.sources.source import RecordingSource
from mapserver.cli import app
from mapserver.config import survey_settings
from mapserver.drafting.draft import BuildOptions, BuildRequest
from mapserver.library import BuiltMap, build_map
from mapserver.plugins.live_surveys.drives import SensorDrive
from mapserver.plugins.live_surveys.live_survey import LiveFigures, run_live
from mapserver.plugins.live_surveys.mapping_process import MappingProcess
from mapserver.plugins.live_surveys.message import MAX_ARRAY_BYTES, LiveSurveyState, NewKeyframe, packed
from mapserver.store import MapStore
from mapserver.survey.survey_inputs import SurveyConfig
from support.recordings.live_drives import Call, MappingHere, order_builds, played
from support.recordings.recording_samples import make_sample, write_mcap
from support.worlds.textured_room import rig, stereo_frame

FRAMES = 24
SETTINGS = survey_settings(None, SensorSet.STEREO_INERTIAL)
QUIET = Console(quiet=True)
Finished = tuple[tuple[LiveFigures, BuiltMap], list[LiveSurveyState], Path]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("recordings") / "walk", make_sample(FRAMES))


@pytest.fixture(scope="module")
def finished(recording: Path, tmp_path_factory) -> Finished:
    """A whole drive at its own speed, all that was told of it, and its store."""
    store, told = tmp_path_factory.mktemp("store") / "maps", list[LiveSurveyState]()
    with played(recording, store) as drive:
        result = run_live(drive, [told.append], lambda: False, QUIET)
    return result, told, store


def test_every_frame_is_tracked_and_every_keyframe_mapped(finished: Finished) -> None:
    (figures, _), told, _ = finished
    last = told[-1]
    assert (last.frames, figures.mapping_failed) == (FRAMES, "")
    assert last.seconds == pytest.approx((FRAMES - 1) * 0.05)
    assert last.latency_ms > 0
    assert len(last.path()) == last.keyframes == figures.state.keyframes > 2
    assert last.behind == 0
    assert last.estimate.status == "TRACKING"
    assert last.rows("cells")[:, 2].sum() > 100
    assert (last.path()[:, 2] > 0.5).all()
    assert len(last.rows("landmarks_m")) > 100
    assert max(cv2.imdecode(np.frombuffer(last.picture, np.uint8), cv2.IMREAD_GRAYSCALE).shape) == 320


def test_its_phases_are_told_in_order_and_end_with_the_draft(finished: Finished) -> None:
    (figures, built), told, _ = finished
    assert list(dict.fromkeys(state.phase for state in told))[-2:] == ["adjusting", "stored"]
    assert (told[-1].version, told[-1].words) == (1, built.sentence)
    assert "live: 24 frames" in figures.words()


def test_the_draft_is_what_a_build_makes_of_the_recording(finished: Finished, recording: Path, tmp_path: Path) -> None:
    (_, mapped), _, store = finished
    built = build_map(recording, tmp_path / "maps", "lab", BuildOptions(settings=SETTINGS))
    assert mapped.trajectory.frame_from_body.tobytes() == built.trajectory.frame_from_body.tobytes()
    with MapStore.open(store) as one, MapStore.open(tmp_path / "maps") as other:
        assert [t.sha256 for t in one.manifest("lab", 1).tiles] == [t.sha256 for t in other.manifest("lab", 1).tiles]


@pytest.fixture
def ordered(monkeypatch) -> list[Call]:
    return order_builds(monkeypatch)


def test_a_drive_that_is_ended_early_is_built_as_far_as_it_went(
    recording: Path, tmp_path: Path, ordered: list[Call]
) -> None:
    seen: list[LiveSurveyState] = []
    calls = iter(range(FRAMES))
    with played(recording, tmp_path / "maps", speed=0) as drive:
        figures, _ = run_live(drive, [seen.append], lambda: next(calls) >= 18, QUIET)
    assert figures.state.frames == 18
    assert figures.state.latency_ms is None
    ((path, *_, options),) = ordered
    assert (path, options) == (recording, BuildOptions(frames="0:18:1", settings=SETTINGS))
    assert seen[-1].latency_ms is None


def test_what_cannot_be_mapped_live_is_refused_before_it_begins(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="100:200"), played(recording, tmp_path / "maps", "100:200"):
        pass
    for speed in (-1.0, float("nan")):
        with pytest.raises(UsageError, match="--speed"), played(recording, tmp_path / "maps", speed=speed):
            pass
    assert not (tmp_path / "maps").exists()


@pytest.mark.usefixtures("ordered")
def test_one_camera_says_that_its_scale_is_not_known_yet(recording: Path, tmp_path: Path) -> None:
    """The camera of this recording only turns: it sees no depth, so that nothing can be mapped."""
    told: list[LiveSurveyState] = []
    with played(recording, tmp_path / "maps", speed=0, use=SensorSet.MONO_INERTIAL) as drive:
        run_live(drive, [told.append], lambda: False, QUIET)
    assert {(state.scale_known, state.keyframes) for state in told[1:]} == {(False, 0)}


def test_sensors_are_recorded_while_they_are_mapped(recording: Path, tmp_path: Path, ordered: list[Call]) -> None:
    """A recording takes the place of the sensors: what comes out must hold all that went in."""
    source = RecordingSource(open_recording(recording), speed=0)
    request = BuildRequest((tmp_path / "drive.mcap",), "lab", tmp_path / "maps")
    figures, _ = run_live(SensorDrive(request, source, Topics()), [], lambda: False, QUIET)
    assert (figures.state.frames, figures.dropped) == (FRAMES, 0)
    with open_recording(recording) as given, open_recording(tmp_path / "drive.mcap") as kept:
        assert kept.frame_stamps_ns.tolist() == given.frame_stamps_ns.tolist()
        np.testing.assert_array_equal(kept.read_frame(5).left, given.read_frame(5).left)
        inside = given.imu.between(0, int(kept.imu.stamps_ns[-1]) + 1)
        np.testing.assert_array_equal(kept.imu.gyro_radps, inside.gyro_radps)
        assert kept.imu.stamps_ns[-1] >= given.frame_stamps_ns[-1]
    ((path, *_, options),) = ordered
    assert (path, options) == (tmp_path / "drive.mcap", BuildOptions(settings=SETTINGS))
    with pytest.raises(UsageError, match="--record"):
        SensorDrive(request, source, Topics())


def test_what_a_killed_survey_has_recorded_can_be_read(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with open_recording(recording) as given:
        writer = McapRecordingWriter(path, given.calibration, in_place=True)
        stamps_ns = [0, *given.frame_stamps_ns.tolist()]
        for number in range(20):
            writer.write_imu(given.imu.between(stamps_ns[number], stamps_ns[number + 1]))
            writer.write_frame(given.stored_frame(number))
        with open_recording(path) as kept:  # nobody has closed the file
            assert 10 <= len(kept) <= 20
            assert any("end" in issue.detail or "end" in issue.what for issue in kept.issues), kept.issues
            np.testing.assert_array_equal(kept.read_frame(3).right, given.read_frame(3).right)
        writer.close()
        with open_recording(path) as kept:
            assert len(kept) == 20


def test_pictures_that_do_not_change_at_all_are_mapped() -> None:
    """A robot that stands, under a camera without noise: every point is seen first by the first of them."""
    mapping = MappingHere(Rectifier(rig(None))).start(SurveyConfig(SETTINGS, default_vocabulary()))
    step = np.diag([1e-4] * 6)
    for number in range(3):
        frame = replace(stereo_frame(50_000_000), stamp_ns=50_000_000 * (number + 1))
        mapping.put(frame, NewKeyframe(number, np.eye(4), np.eye(3), step if number else None, np.zeros(9)))
    assert len(mapping.map.points_map()) > 100
    np.testing.assert_allclose(mapping.map_from_body[:, :3, 3], 0.0, atol=0.01)


@pytest.mark.parametrize(
    "given", [[], ["a.mcap", "--sensors", "s.toml", "--record", "r.mcap"], ["--sensors", "s.toml"]]
)
def test_one_source_must_be_named(given: list[str], tmp_path: Path) -> None:
    said = CliRunner().invoke(app, ["live", *given, "--site", "lab", "--store", str(tmp_path / "maps")])
    assert isinstance(said.exception, UsageError)
    assert "--sensors FILE" in str(said.exception)


def test_mapping_that_does_not_start_is_an_error_with_a_next_step() -> None:
    broken: Any = None  # settings without which the process ends before it is ready
    with pytest.raises(FleetmapError, match="did not start"):
        MappingProcess(broken).start(broken)


class _Unreadable:
    """What another process cannot load."""

    def __reduce__(self) -> tuple[type[int], tuple[str]]:
        return int, ("no number",)


def test_a_process_that_dies_before_it_has_read_its_orders_is_not_waited_for() -> None:
    orders: Any = (_Unreadable(), bytes(1 << 20))  # more than a pipe holds
    with pytest.raises(FleetmapError, match="did not start"):
        MappingProcess(orders).start(orders)


def test_thinned_rows_fit_a_message_and_keep_the_last() -> None:
    rows = np.arange(100_000.0).reshape(-1, 2)
    kept = np.frombuffer(packed(rows), "<f4").reshape(-1, 2)
    assert 4 * kept.size <= MAX_ARRAY_BYTES
    assert kept[-1].tolist() == rows[-1].tolist()
    assert len({*np.diff(kept[:, 0])}) == 1
    assert packed(rows[:3]) == rows[:3].astype("<f4").tobytes()
    assert packed(rows[:0]) == b""
    full = bytes(MAX_ARRAY_BYTES)
    state = LiveSurveyState(
        site="s" * 64, recording="r", stamp_ns=1, phase="tracking", seconds=1.0, frames=1, keyframes=1,
        path_m=full, quality=full[: MAX_ARRAY_BYTES // 8], landmarks_m=full, loops_m=full, picture=full,
    )  # fmt: skip
    assert len(encode_message(state)) < MAX_MESSAGE_BYTES
