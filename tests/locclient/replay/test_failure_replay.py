"""A failure's recording repeats what the robot said, to the bit; another map may say otherwise; what no robot wrote is refused."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import zstandard

from fleetmap.errors import RecordingError
from fleetmap.messages import FailureReport
from fleetmap.recordings import open_recording
from fleetmap.recordings.failure_recording import LOCALIZER, SUMMARY, attachments_of
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from locclient import cli
from locclient.delivery.failure_file import read_failure_file
from locclient.maps.map_source import LocalMapSource
from locclient.replay.failure_replay import Comparison, compare_failure
from locclient.replay.replay import load_map
from mapserver.store import MapStore
from support.fleet.failed_robot import failed
from support.recordings.recording_samples import calibration
from support.worlds import robot_world


@dataclass
class Carried:
    """A robot that was put down 2.4 m away."""

    folder: Path
    file: Path
    report: FailureReport
    said: list[str]

    def compare(self, manifest: str | None = None) -> Comparison:
        return compare_failure(read_failure_file(self.file), LocalMapSource(self.folder / "store", "room"), manifest)


@pytest.fixture(scope="module")
def carried(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Carried]:
    folder = tmp_path_factory.mktemp("carried")
    with MapStore.open(folder / "store", create=True) as store:
        robot_world.save(store)
        found = failed(robot_world.carried(140, 75), load_map(LocalMapSource(folder / "store", "room"))[0])
        # Version 2 lies half a metre higher: the same failure, other places.
        robot_world.save(store, of=robot_world.moved(np.array([0.0, 0.0, 0.5])))
    assert found is not None
    report, data, said = found
    (folder / "failure.mcap").write_bytes(data)
    yield Carried(folder, folder / "failure.mcap", report, said)


def test_the_same_client_says_the_same_to_the_bit(carried: Carried) -> None:
    found = carried.compare()
    assert [moment.status for moment in found.now] == carried.said
    assert len({*carried.said}) > 1, "the robot failed meanwhile"
    assert found.first_difference_ns is None
    assert list(found.summary.moments) == found.now
    assert "says the same" in found.answer


def test_it_begins_five_seconds_before_and_ends_five_after(carried: Carried) -> None:
    summary, record = read_failure_file(carried.file)
    times_s = (np.array([moment.stamp_ns for moment in summary.moments]) - carried.report.stamp_ns) * 1e-9
    assert -6.5 < times_s[0] <= -5.0
    assert 4.9 < times_s[-1] < 5.2
    assert (summary.robot, summary.id, summary.version) == ("r1", "f1", 1)
    assert len(record.frames) == len(summary.moments)


def test_another_version_is_asked_for_its_own_places(carried: Carried) -> None:
    with MapStore.open(carried.folder / "store", read_only=True) as store:
        sha256 = store.version("room", 2).manifest_sha256
    found = carried.compare(sha256)
    assert found.version == 2
    assert found.first_difference_ns is not None
    then, now = (next(m for m in moments[::-1] if m.position_map_m) for moments in (found.summary.moments, found.now))
    assert now.position_map_m[2] - then.position_map_m[2] == pytest.approx(0.5, abs=0.05)
    assert "version 2" in found.answer


def test_it_is_a_recording_with_reduced_pictures(carried: Carried) -> None:
    with open_recording(carried.file) as recording:
        assert recording.issues == ()
        assert recording.sensor_set == "stereo-inertial"
        assert 10 <= len(recording) <= 25
        assert len(recording.imu) > 1000
        assert len(recording.stored_frame(0).left.data) < 25_000


def test_blurred_pictures_show_no_detail(carried: Carried, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        robot_world.save(store)
        found = failed(robot_world.carried(90, 75), robot_world.loaded(store), "blurred")
    assert found is not None
    (tmp_path / "blurred.mcap").write_bytes(found[1])
    with open_recording(carried.file) as sharp, open_recording(tmp_path / "blurred.mcap") as blurred:
        detail = [cv2.Laplacian(each.read_frame(3).left, cv2.CV_64F).var() for each in (sharp, blurred)]
    assert detail[1] < 0.1 * detail[0]
    assert read_failure_file(tmp_path / "blurred.mcap")[0].pictures == "blurred"


def _changed(carried: Carried, path: Path, localizer: bytes) -> Path:
    with McapRecordingWriter(path, calibration()) as writer:
        writer.attach(SUMMARY, "", attachments_of(carried.file)[SUMMARY])
        writer.attach(LOCALIZER, "", localizer)
    return path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda state: {**state, "format": 2}, "another fleetmap"),
        (lambda state: {k: v for k, v in state.items() if k != "state"}, "another fleetmap"),
        (lambda state: {**state, "body_from_cam": ["|O8", [4, 4], b"x" * 128]}, "another fleetmap"),
        (lambda state: {**state, "body_from_cam": ["<f8", [1 << 40, 4], b"x"]}, "another fleetmap"),
        (lambda state: {**state, "frames": []}, "another fleetmap"),
    ],
)
def test_a_state_that_no_robot_wrote_is_refused(carried: Carried, tmp_path: Path, change: object, said: str) -> None:
    packed = attachments_of(carried.file)[LOCALIZER]
    state = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed), strict=False)
    spoiled = zstandard.ZstdCompressor().compress(msgspec.msgpack.encode(change(state)))
    with pytest.raises(RecordingError, match=said):
        read_failure_file(_changed(carried, tmp_path / "spoiled.mcap", spoiled))


def test_what_unpacks_without_end_is_refused(carried: Carried, tmp_path: Path) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(300_000_000))
    with pytest.raises(RecordingError, match="no robot writes that"):
        read_failure_file(_changed(carried, tmp_path / "bomb.mcap", bomb))
    with pytest.raises(RecordingError, match="cannot be unpacked"):
        read_failure_file(_changed(carried, tmp_path / "none.mcap", b"no zstd"))


def test_damaged_and_other_recordings_are_refused(carried: Carried, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(carried.file.read_bytes()[:-5000])
    with pytest.raises(RecordingError, match="damaged"):
        read_failure_file(tmp_path / "cut.mcap")
    with McapRecordingWriter(tmp_path / "other.mcap", calibration()):
        pass
    with pytest.raises(RecordingError, match="no failure's recording"):
        read_failure_file(tmp_path / "other.mcap")


def test_the_command_answers(
    carried: Carried, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        sys, "argv", ["locclient", "replay-failure", str(carried.file), "--store", str(carried.folder / "store")]
    )
    with pytest.raises(SystemExit) as end:
        cli.main()
    said = capsys.readouterr().out
    assert end.value.code in (0, None), said
    assert "then:" in said
    assert "says the same of every frame" in said
