"""Drives through requested areas: what a robot keeps of them, and how it hands them in."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import UnreachableError
from fleetmap.failure_summary import ReplayPart
from fleetmap.geometry import se3
from fleetmap.messages import Cause, FailureAck, Status, SurveyArea, decode_message
from fleetmap.recordings import open_recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.delivery import survey_drives
from locclient.delivery.survey_drives import SurveyDrives
from support.recordings.recording_samples import HEIGHT, WIDTH, calibration
from support.worlds.robot_world import turned

AREA = SurveyArea(id="ab12ab12", corners_map_m=[(20.0, -2.0), (30.0, -2.0), (30.0, 2.0), (20.0, 2.0)])
STEP_NS = 50_000_000  # twenty frames a second
PICTURE = np.zeros((HEIGHT, WIDTH), np.uint8)


def made(folder: Path, rig: RigCalibration | None = None) -> SurveyDrives:
    drives = SurveyDrives(folder, rig or calibration())
    drives.requests = (AREA,)
    return drives


def drive(
    drives: SurveyDrives, x_m: Iterable[float], start_ns: int = 10**12, *, lost: tuple[float, float] = (0, 0),
    others: tuple[CameraFrame, ...] = (),
) -> None:  # fmt: skip
    """Along x, without a known place between two of them; who stands at 25.25 m is lifted."""
    for number, x in enumerate(x_m):
        stamp_ns = start_ns + number * STEP_NS
        is_lost = lost[0] < x < lost[1]
        estimate: Any = SimpleNamespace(
            status=Status.LOST if is_lost else Status.TRACKING,
            map_from_body=None if is_lost else se3(np.eye(3), np.array([x, 0.0, 0.0])),
            stamp_ns=stamp_ns,
            cause=Cause.CARRIED if x == 25.25 else Cause.NONE,
        )
        seen = tuple(replace(other, stamp_ns=stamp_ns) for other in others)
        drives.handle(SensorBundle(CameraFrame(stamp_ns, PICTURE, PICTURE, others=seen)), estimate)
        drives.work()


def kept(folder: Path) -> list[tuple[int, float]]:
    """Frames and seconds of each drive on the disk."""
    found = []
    for path in sorted(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns):
        with open_recording(path) as recording:
            stamps = recording.frame_stamps_ns
            found.append((len(stamps), round(float(stamps[-1] - stamps[0]) * 1e-9, 2)))
    return found


def test_a_drive_begins_before_its_area_and_ends_behind_it(tmp_path: Path) -> None:
    drives = made(tmp_path)
    drive(drives, np.arange(0.0, 50.0, 0.1))
    ((frames, seconds),) = kept(tmp_path)
    assert seconds == pytest.approx((30 + 6 - (20 - 6)) / 0.1 * 0.05, abs=0.5), "six metres on both sides"
    assert frames == pytest.approx(10 * seconds, rel=0.05), "ten frames a second"
    drive(drives, np.arange(0.0, 50.0, 0.1), 2 * 10**12)
    drive(drives, np.arange(0.0, 50.0, 0.1), 3 * 10**12)
    assert len(kept(tmp_path)) == 2, "two drives are enough for a request"


def test_a_robot_that_loses_its_place_goes_on_recording(tmp_path: Path) -> None:
    drive(made(tmp_path), np.arange(0.0, 50.0, 0.1), lost=(22.0, 29.0))
    ((frames, seconds),) = kept(tmp_path)
    assert frames == pytest.approx(10 * seconds, rel=0.05)
    assert seconds > 10


def test_a_drive_in_which_the_robot_is_lifted_is_not_kept(tmp_path: Path) -> None:
    drive(made(tmp_path), np.arange(0.25, 37.0, 0.5))
    assert [frames for frames, _ in kept(tmp_path)] == [11], "another one begins behind that place"


def test_what_shows_nothing_of_the_area_is_not_kept(tmp_path: Path) -> None:
    drives = made(tmp_path)
    drive(drives, [16.0] * 200)  # it stands there
    drive(drives, [*np.arange(10.0, 18.0, 0.1), *np.arange(18.0, 8.0, -0.1)], 2 * 10**12)  # and turns back before it
    assert list(tmp_path.iterdir()) == []
    drive(drives, np.arange(0.0, 25.0, 0.1), 3 * 10**12)
    drives.requests = ()
    drive(drives, [25.0], 4 * 10**12)
    assert len(kept(tmp_path)) == 1, "somebody closed the request on the way: the server refuses it"
    assert not list(SurveyDrives(tmp_path, calibration()).requests)


def test_a_drive_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drives = made(tmp_path)
    drive(drives, np.full(200, 0.0))
    monkeypatch.setattr(survey_drives, "_LONGEST_NS", 4 * 10**9)
    drive(drives, np.arange(12.0, 40.0, 0.05), 2 * 10**12)
    assert all(seconds < 4.2 for _, seconds in kept(tmp_path))
    (tmp_path / "x.mcap.part").write_bytes(b"half")
    monkeypatch.setattr(survey_drives, "MAX_DRIVE_BYTES", 50_000)
    drives = made(tmp_path)
    assert not (tmp_path / "x.mcap.part").exists()
    before = set(tmp_path.iterdir())
    drive(drives, np.arange(18.0, 40.0, 0.05), 3 * 10**12)
    assert all(path.stat().st_size <= 50_000 for path in {*tmp_path.glob("*.mcap")} - before)


def test_a_rigs_drive_is_bounded_by_the_images_of_all_its_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A drive that grew too large would be lost at its end."""
    front = calibration().cameras
    drives = made(tmp_path, RigCalibration(front + turned(front), calibration().imu))
    monkeypatch.setattr(survey_drives, "MAX_DRIVE_BYTES", 400_000)
    noise = np.random.default_rng(1).integers(0, 255, PICTURE.shape, np.uint8)
    drive(drives, np.arange(0.0, 50.0, 0.1), others=(CameraFrame(0, noise, noise),))
    paths = list(tmp_path.glob("*.mcap"))
    assert paths and all(path.stat().st_size <= 400_000 for path in paths)
    with open_recording(paths[0]) as recording:
        assert len(recording.calibration.views) == 2 and recording.read_frame(0).others[0] is not None


def test_parts_are_sent_in_order_and_begun_again(tmp_path: Path) -> None:
    drives = made(tmp_path)
    drive(drives, np.arange(0.0, 50.0, 0.1))
    (path,) = tmp_path.glob("*.mcap")
    data, taken, faults = path.read_bytes(), bytearray(), ["away", "", "restarted"]

    def send(_: str, payload: bytes) -> FailureAck:
        part = decode_message(payload, ReplayPart)
        fault = faults.pop(0) if faults else ""
        if fault == "away":
            raise UnreachableError("nobody answers")
        if fault == "restarted":
            taken.clear()
            return FailureAck(id=part.id)
        assert (part.survey, part.total_bytes, part.offset) == (AREA.id, len(data), len(taken))
        taken.extend(part.data)
        return FailureAck(id=part.id, received_bytes=len(taken))

    client: Any = SimpleNamespace(deliver=send)
    assert not drives.deliver_part(client)
    for _ in range(50):
        drives.deliver_part(client)
    assert bytes(taken) == data
    assert list(tmp_path.iterdir()) == []
