"""The nightly job, with real recordings, a real store and a build that takes no time: what it does when it is interrupted."""

import contextlib
import errno
import fcntl
import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from asyncio import CancelledError
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, patch

import msgspec
import numpy as np
import psutil
import pytest
from rich.console import Console

from fleetmap.errors import BusyError, GateRefusedError, RecordingError, StoreError, SurveyError, UsageError
from fleetmap.mapformat.manifest import RecordingEntry
from fleetmap.recordings import OpenOptions, open_recording
from fleetmap.sensors.samples import SensorSet
from mapserver import releases
from mapserver.config import survey_settings
from mapserver.drafting.draft import BuildOptions, BuildRequest, Draft
from mapserver.drafting.survey_recordings import OpenRecordings, RecordingOptions, admit_recordings, survey_all
from mapserver.nightly import inbox as boxes
from mapserver.nightly.inbox import arrivals
from mapserver.plugins.nightly_builds import night, recordings
from mapserver.plugins.nightly_builds.night import NightReport, NightRequest, last_report, run_night
from mapserver.plugins.nightly_builds.recordings import InboxRecording, identify, read
from mapserver.quality.gate import GateSettings
from mapserver.store import DraftContent, FleetRetention, MapStore
from mapserver.store.files import locked
from mapserver.survey.settings import SurveySettings
from support.command_line import status
from support.fleet.contracts_documents import code_words, rows, section
from support.recordings.recording_samples import Sample, make_sample, write_euroc, write_mcap
from support.storage.faulty_disk import Disk, in_child
from support.storage.map_samples import draft_details, random_tile
from support.waiting import within_another_process

LATER_NS = 3_600 * 10**9
READ = recordings._read
Build = Callable[..., tuple[Draft, None]]


def record(inbox: Path, name: str, number: int, write: Callable[[Path, Sample], Path] = write_euroc) -> Path:
    """A small recording like no other number's."""
    sample = make_sample(3)
    sample.left[0][0, :8] = number
    return write(inbox / name, sample)


def built(
    request: BuildRequest, _: SurveySettings, unusable: dict[Path, str], *, landmarks: int = 60
) -> tuple[Draft, None]:
    """A draft with what a build would say; recordings named "lost" find no place, those named "dark" cannot be surveyed."""
    entries, left_out = [], {}
    for path in request.recordings:
        with open_recording(path) as recording:
            entry = RecordingEntry(name=path.name, sha256=recording.content_hash(), frames=len(recording))
        if "dark" in path.name:
            unusable[path] = "too dark"
        elif "lost" in path.name:
            left_out[entry.sha256] = "at most 1 of 3 fixes agree"
        else:
            entries.append(entry)
    if not entries:
        raise SurveyError("nothing could be joined")
    details = msgspec.structs.replace(draft_details(), recordings=tuple(entries))
    tile = random_tile(np.random.default_rng(len(entries)), landmarks=landmarks, places=2)
    options = request.options
    content = DraftContent(tiles=[tile], vocabulary=b"words", details=details, job=options.job)
    with MapStore.open(request.store) as maps:
        version = maps.save(request.site, content, actor=options.actor).version
    return Draft(version, f"draft {version}", {"keyframes": 2}, left_out), None


@pytest.fixture(autouse=True)
def quick(monkeypatch) -> None:
    monkeypatch.setattr(night, "build_draft", built)
    monkeypatch.setattr(recordings, "_read", lambda path, options, _: read(path, options))


@pytest.fixture
def hall(tmp_path: Path) -> Path:
    """A folder with an inbox of two recordings, in two formats."""
    record(tmp_path / "inbox", "monday", 0)
    record(tmp_path / "inbox", "tuesday", 1, write_mcap)
    return tmp_path


def spend(folder: Path, **more: Any) -> str:
    """One night, some time after everything came in."""
    order = NightRequest("hall", folder / "inbox", folder / "store", time.time_ns() + LATER_NS, **more)
    return run_night(order, GateSettings(), Console(file=io.StringIO()))


def test_a_night_surveys_with_the_preset_of_the_sensors_as_a_build_does(hall: Path, monkeypatch) -> None:
    config, build = hall / "site.toml", Mock(side_effect=built)
    config.write_text("[survey]\nseed = 5\n")
    monkeypatch.setattr(night, "build_draft", build)
    monkeypatch.setattr("mapserver.library.sensor_set_of", lambda *_: SensorSet.MONO)
    spend(hall, options=BuildOptions(config=config))
    used = build.call_args.args[1]
    assert used == survey_settings(config, SensorSet.MONO) != survey_settings(config, SensorSet.STEREO_INERTIAL)
    assert used.seed == 5


def test_a_night_removes_what_is_older_than_its_period(hall: Path) -> None:
    spend(hall)
    assert spend(hall, retention=FleetRetention(recording_days=1e-9)) == "site hall: nothing new"
    assert names(hall / "inbox/done") == []
    assert last_report(hall / "store", "hall")["expired"] == {"recordings of surveys": 2}


def states(folder: Path) -> list[tuple[str, list[str]]]:
    with MapStore.open(folder / "store") as maps:
        versions = maps.versions("hall")
        return [(v.state, sorted(r.name for r in maps.manifest("hall", v.version).recordings)) for v in versions]


def names(folder: Path) -> list[str]:
    return sorted(path.name.split("-", 1)[-1] for path in folder.iterdir()) if folder.is_dir() else []


def test_what_came_in_becomes_a_version_once(hall: Path) -> None:
    assert "version 1 published, 2 done" in spend(hall)
    assert states(hall) == [("current", ["monday", "tuesday"])]
    assert names(hall / "inbox") == ["done"]
    assert spend(hall) == "site hall: nothing new"
    record(hall / "inbox", "monday again", 0)
    assert spend(hall) == "site hall: nothing new"
    assert names(hall / "inbox/done") == ["monday", "monday again", "tuesday"]
    assert len(states(hall)) == 1
    with MapStore.open(hall / "store") as maps:
        assert [job.state for job in maps.jobs("hall")] == ["done"] * 3
        assert [event.actor for event in maps.events("hall") if event.kind == "published"] == ["nightly"]


def test_some_robots_try_a_nights_version_first(hall: Path) -> None:
    assert "version 1 published" in spend(hall, trial_share=0.5), "there is no other one to compare it with"
    with MapStore.open(hall / "store") as maps:
        for robot in ("r1", "r2"):
            maps.record_robot_report("hall", robot, {})
    record(hall / "inbox", "wednesday", 2)
    assert "version 2 published, 1 done" in spend(hall, trial_share=0.5)
    assert [state for state, _ in states(hall)] == ["current", "published"]
    record(hall / "inbox", "thursday", 3)
    assert spend(hall, trial_share=0.5) == "site hall: nothing new"
    (told,) = last_report(hall / "store", "hall")["waiting"]
    assert told == {"name": "thursday", "reason": "not yet: version 2 is on trial"}


def test_each_recording_goes_where_it_belongs_with_its_reason(hall: Path) -> None:
    record(hall / "inbox", "lost one", 7)
    max((record(hall / "inbox", "dark one", 8) / "mav0/cam1/data").iterdir()).unlink()
    (hall / "inbox/empty").mkdir()
    (hall / "inbox/notes.txt").write_text("not for the night")
    assert "2 done, 1 held, 2 bad" in spend(hall)
    assert names(hall / "inbox/held") == ["lost one", "lost one.reason.txt"]
    assert names(hall / "inbox/bad") == ["dark one", "dark one.reason.txt", "empty", "empty.reason.txt"]
    assert "empty folder" in (hall / "inbox/bad/empty.reason.txt").read_text()
    (reason,) = (path.read_text() for path in (hall / "inbox/bad").glob("*dark one.reason.txt"))
    assert "too dark; when it was read: cam1: images missing: 1 of" in reason
    assert (hall / "inbox/notes.txt").is_file()
    report = last_report(hall / "store", "hall")
    assert {r["name"]: r["fate"] for r in report["recordings"]} == {
        "monday": "done", "tuesday": "done", "lost one": "held", "dark one": "bad", "empty": "bad",
    }  # fmt: skip


def test_a_recording_that_the_doctor_refuses_does_not_stop_the_others(hall: Path) -> None:
    """Left and right swapped, in a build that may leave recordings out; alone, or where none may be left out, it is an error."""
    sample = make_sample(6)
    sample.left, sample.right = sample.right, sample.left
    swapped, sound = write_euroc(hall / "swapped", sample), write_euroc(hall / "sound", make_sample(6))
    unusable: dict[Path, str] = {}

    def admit(*paths: Path, unusable: dict[Path, str] | None) -> list[Path]:
        console = Console(file=io.StringIO())
        return list(
            admit_recordings(
                paths, OpenRecordings(RecordingOptions(), hall), console, needs_truth=False, unusable=unusable
            )
        )

    assert admit(swapped, sound, unusable=unusable) == [sound]
    assert "left and right" in unusable[swapped]
    for paths, taken in (((swapped, sound), None), ((swapped,), {})):
        with pytest.raises(RecordingError, match="left and right"):
            admit(*paths, unusable=taken)


def test_a_refused_night_keeps_the_last_version_and_holds_its_recordings(hall: Path, monkeypatch) -> None:
    spend(hall)
    record(hall / "inbox", "wednesday", 3)
    monkeypatch.setattr(night, "build_draft", lambda *a: built(*a, landmarks=10))
    with pytest.raises(GateRefusedError, match="number of landmarks"):
        spend(hall)
    assert states(hall) == [("current", ["monday", "tuesday"]), ("draft", ["wednesday"])]
    assert names(hall / "inbox/held") == ["wednesday", "wednesday.reason.txt"]
    report = last_report(hall / "store", "hall")
    assert report["state"] == "failed"
    assert "number of landmarks" in report["message"]
    assert "version 1 stays current" in report["message"]
    assert spend(hall) == "site hall: nothing new"
    monkeypatch.setattr(night, "build_draft", built)
    held = next(path for path in (hall / "inbox/held").iterdir() if path.is_dir())
    held.rename(hall / "inbox" / held.name)  # somebody looked at it, and wants it tried again
    assert "version 3 published" in spend(hall)


def test_what_the_gate_refuses_takes_no_other_recording_with_it(hall: Path, monkeypatch) -> None:
    spend(hall)
    for seed, name in enumerate(("wednesday", "thursday"), 3):
        record(hall / "inbox", name, seed)
    is_poor = lambda request: any("wednesday" in path.name for path in request.recordings)  # noqa: E731
    monkeypatch.setattr(night, "build_draft", lambda *a: built(*a, landmarks=10) if is_poor(a[0]) else built(*a))
    assert "published, 1 done, 1 held" in spend(hall)
    assert ("current", ["thursday"]) in states(hall)
    assert names(hall / "inbox/held") == ["wednesday", "wednesday.reason.txt"]


HOSTILE_NAMES = {
    "long": b"x" * 240 + b".mcap",
    "no UTF-8": b"caf\xe9.mcap",
    "a line of its own": b"tote\n2026-11-22 00:00:00 INFO all is well.mcap",
}


def test_a_name_that_cannot_be_used_goes_to_bad_and_the_night_goes_on(hall: Path) -> None:
    paths = [Path(os.fsdecode(os.fsencode(hall / "inbox") + b"/" + name)) for name in HOSTILE_NAMES.values()]
    for path in paths:
        path.write_bytes(b"x")
    assert "2 done, 0 held, 3 bad" in spend(hall)
    kept = sorted(found.name for found in (hall / "inbox/bad").iterdir())
    for name, reason in zip(kept[::2], kept[1::2], strict=True):
        assert re.fullmatch(r"unnamed-[0-9a-f]{12}\.mcap", name)
        assert reason == f"{name}.reason.txt"
        assert len((hall / "inbox/bad" / reason).read_text("utf-8").splitlines()) == 1
    assert states(hall) == [("current", ["monday", "tuesday"])]


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as bound, contextlib.chdir(path.parent):
        bound.bind(path.name)


def _in_recording(make: Callable[[Path], object], name: str = "mav0/cam0/data/more") -> Callable[[Path], object]:
    """A recording with something else in it."""

    def made(path: Path) -> None:
        record(path.parent, path.name, 9)
        (path / name).unlink(missing_ok=True)
        make(path / name)

    return made


def _sparse(size_bytes: int, begin: bytes = b"") -> Callable[[Path], object]:
    def made(path: Path) -> None:
        path.write_bytes(begin)
        os.truncate(path, size_bytes)

    return made


def _deep(path: Path) -> None:
    with contextlib.chdir(path.parent):
        for _ in range(120):
            Path("d" * 40).mkdir()
            os.chdir("d" * 40)


BAD_ENTRIES = {
    "a link that leads to itself": (lambda path: path.symlink_to(path.name), "symbolic link"),
    "a link to nothing": (lambda path: path.symlink_to("nowhere"), "symbolic link"),
    "a link out of the inbox": (lambda path: path.symlink_to("/etc"), "symbolic link"),
    "a FIFO": (os.mkfifo, "FIFO"),
    "a socket": (_socket, "socket"),
    "a loop in a folder": (_in_recording(lambda path: path.symlink_to(path.name)), "more is a symbolic link"),
    "a FIFO in a folder": (_in_recording(os.mkfifo), "more is a FIFO"),
    "a FIFO as a table": (_in_recording(os.mkfifo, "mav0/imu0/data.csv"), "data.csv is a FIFO"),
    "folders without end": (_in_recording(_deep), "levels of folders"),
    "a table of terabytes": (_in_recording(_sparse(1 << 41), "mav0/imu0/data.csv"), "at most 1073741824 are read"),
    "a table of one line": (
        _in_recording(lambda path: path.write_bytes(b"1" * (64 << 20)), "mav0/imu0/data.csv"),
        "no row",
    ),
    "a calibration of terabytes": (
        _in_recording(_sparse(1 << 41), "mav0/cam0/sensor.yaml"),
        "at most 1048576 are read",
    ),
    "a zip file": (lambda path: path.write_bytes(b"PK\3\4" + bytes(30)), "`unzip` it"),
    "an MCAP file of holes": (_sparse(1 << 41, b"\x89MCAP0\r\n"), "MCAP"),
}


def test_bad_entries_go_to_bad_with_their_reasons_and_the_night_goes_on(hall: Path) -> None:
    for number, (make, _) in enumerate(BAD_ENTRIES.values()):
        make(hall / f"inbox/{number:02d}.mcap")
    assert f"2 done, 0 held, {len(BAD_ENTRIES)} bad" in spend(hall)
    for number, (kind, (_, reason)) in enumerate(BAD_ENTRIES.items()):
        assert reason in (hall / f"inbox/bad/{number:02d}.mcap.reason.txt").read_text(), kind
        assert os.path.lexists(hall / f"inbox/bad/{number:02d}.mcap")
    assert states(hall) == [("current", ["monday", "tuesday"])]


@pytest.mark.parametrize("where", [boxes.DONE, boxes.HELD, boxes.BAD])
def test_a_folder_of_the_inbox_that_is_a_link_moves_nothing(hall: Path, where: str) -> None:
    outside = hall / "outside"
    outside.mkdir()
    (outside / "store.mcap").write_bytes(b"x")
    (hall / "inbox" / where).symlink_to(outside)
    (hall / "inbox/broken.mcap").write_bytes(b"x")
    record(hall / "inbox", "lost one", 7)
    spend(hall)
    with pytest.raises(StoreError, match="symbolic link"):
        boxes.put_back(hall / "inbox", where, "store.mcap")
    shown = boxes.contents(hall / "inbox", 0.0, 0)
    assert "store.mcap" not in {entry.name for entry in (*shown.held, *shown.bad)}
    assert names(outside) == ["store.mcap"]


def test_who_writes_a_recording_while_it_is_looked_at_ends_no_night(hall: Path, monkeypatch) -> None:
    """A file lease that is broken sends SIGIO, which ends a process."""
    control = fcntl.fcntl

    def written_meanwhile(descriptor: int, command: int, value: int) -> int:
        found = control(descriptor, command, value)
        if value == fcntl.F_RDLCK:
            with contextlib.suppress(BlockingIOError):
                os.open(f"/proc/self/fd/{descriptor}", os.O_WRONLY | os.O_NONBLOCK)
        return found

    heard: list[int] = []
    before = signal.signal(signal.SIGIO, lambda number, _: heard.append(number))
    monkeypatch.setattr(fcntl, "fcntl", written_meanwhile)
    spend(hall)
    signal.signal(signal.SIGIO, before)
    assert heard == []


def test_nothing_waits_without_a_word(hall: Path, monkeypatch) -> None:
    """What is left where it is, is named: no recordings, what cannot be moved, what changes while it is read, and what is too much."""
    for name in ("notes.txt", "photo.png", "x.mcap", "y.mcap", "z.mcap"):
        (hall / "inbox" / name).write_bytes(b"no MCAP")
    changing = record(hall / "inbox", "changing", 5)
    read = open_recording

    def while_it_is_copied(path: Path, *more: object) -> object:
        if path == changing and not (path / "mav0/late").exists():
            (path / "mav0/late").write_bytes(b"late")
        return read(path, *more)

    monkeypatch.setattr(recordings, "open_recording", while_it_is_copied)
    monkeypatch.setattr(night, "_MOST_A_NIGHT", 4)
    replace = os.replace

    def only_others(source: Path, target: Path) -> None:
        if Path(source).name == "x.mcap":
            raise PermissionError(errno.EPERM, "Operation not permitted")
        replace(source, target)

    monkeypatch.setattr(os, "replace", only_others)
    assert "2 done, 0 held, 0 bad" in spend(hall)
    report = last_report(hall / "store", "hall")
    told = {waiting["name"]: waiting["reason"] for waiting in report["waiting"]}
    assert "changed while it was read" in told["changing"]
    assert "Operation not permitted" in told["x.mcap"]
    assert "bad: " in told["x.mcap"]
    assert "like 1 more: a night takes 4" in told["y.mcap"]
    assert "no recording, like 1 more" in told["notes.txt"]
    assert names(hall / "inbox/bad") == []
    (hall / "inbox/x.mcap").unlink()
    assert spend(hall) == "site hall: version 2 published, 1 done, 0 held, 2 bad"


def test_files_that_may_not_be_read_end_no_night() -> None:
    """Of an account that is not root, which may read everything."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (record(folder / "inbox", "other", 5) / "mav0").chmod(0)
        record(folder / "inbox", "own", 6)
        if os.getuid() == 0:
            for path in (folder, *folder.rglob("*")):
                os.chown(path, 65534, 65534)
        child = os.fork()
        if child == 0:
            try:
                if os.getuid() == 0:
                    os.setuid(65534)
                os._exit(0 if "1 done, 0 held, 1 bad" in spend(folder) else 1)
            finally:
                os._exit(2)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert "Permission denied" in (folder / "inbox/bad/other.reason.txt").read_text()


@pytest.mark.parametrize("where", ["read", "built", "joined", "broken"])
def test_what_ended_two_nights_is_set_aside_by_the_third_and_nothing_beside_it(
    hall: Path, where: str, monkeypatch
) -> None:
    """Killed while one recording is read, surveyed or joined with the others, as by the kernel; a fault of the program ends no night."""
    fatal = record(hall / "inbox", "fatal", 5)
    read = open_recording

    def killed(path: Path) -> None:
        if path == fatal and where == "broken":
            raise np.linalg.LinAlgError("SVD did not converge")
        if path == fatal:
            os.kill(os.getpid(), signal.SIGKILL)

    def reads(path: Path, *more: object) -> object:
        killed(path)
        return read(path, *more)

    def builds(request: BuildRequest, settings: SurveySettings, unusable: dict[Path, str]) -> tuple[Draft, None]:
        for path in request.recordings:
            request.options.look_at(request.recordings if where == "joined" else [path])
            killed(path)
        return built(request, settings, unusable)

    monkeypatch.setattr(*((recordings, "open_recording", reads) if where == "read" else (night, "build_draft", builds)))
    for _ in range({"broken": 0, "joined": 3}.get(where, 2)):
        assert in_child(lambda: spend(hall), Disk("/nowhere"), hall / "told")[0] == -signal.SIGKILL
        assert (hall / "inbox/fatal").is_dir()
    assert "1 bad" in spend(hall)
    reason = {"broken": "LinAlgError: SVD did not converge; a bug"}.get(
        where, " nights ended while this was read or built"
    )
    assert reason in next((hall / "inbox/bad").glob("*fatal.reason.txt")).read_text()
    taken = [["monday"], ["tuesday"]] if where in {"joined", "broken"} else [["monday", "tuesday"]]
    assert [recordings for _, recordings in states(hall)] == taken
    next((hall / "inbox/bad").glob("*fatal")).rename(fatal)
    monkeypatch.undo()
    monkeypatch.setattr(night, "build_draft", built)
    assert f"version {len(taken) + 1} published" in spend(hall), "it is tried again"


def test_a_fault_of_the_program_leaves_one_recording_out_of_a_build() -> None:
    unusable: dict[Path, str] = {}

    def survey_one(path: Path, _: object) -> Any:
        if path.name == "fatal":
            raise ZeroDivisionError("division by zero")
        return [SimpleNamespace(survey=SimpleNamespace(state=SimpleNamespace(rig=SimpleNamespace(camera=None))))]

    assert len(survey_all([Path("fatal"), Path("sound")], survey_one, None, unusable)) == 1
    assert "ZeroDivisionError: division by zero" in unusable[Path("fatal")]
    with pytest.raises(ZeroDivisionError):
        survey_all([Path("fatal")], survey_one, None)


@pytest.mark.parametrize(
    ("limit", "value", "said"),
    [("_READ_S", 0.05, "was ended after 0 s"), ("_most_memory_bytes", lambda: 1 << 20, "monday")],
)
def test_reading_has_limits(hall: Path, monkeypatch, limit: str, value: object, said: str) -> None:
    monkeypatch.setattr(recordings, "_read", READ)
    assert isinstance(identify(hall / "inbox/monday", OpenOptions()), InboxRecording)
    monkeypatch.setattr(recordings, limit, value)
    found = identify(hall / "inbox/monday", OpenOptions())
    assert isinstance(found, str)
    assert said in found


def test_nothing_joined_is_a_failed_night(hall: Path) -> None:
    spend(hall)
    record(hall / "inbox", "lost", 5)
    with pytest.raises(SurveyError, match="nothing could be joined"):
        spend(hall)
    assert names(hall / "inbox/held") == ["lost", "lost.reason.txt"]
    assert len(states(hall)) == 1


def test_half_copied_recordings_wait(tmp_path: Path) -> None:
    inbox = tmp_path / "inbox"
    record(inbox, "whole", 1)
    record(inbox, "copied", 2)
    (inbox / "copied/mav0/cam0/data/image9.png.part").write_bytes(b"half")
    (inbox / "sent.mcap.filepart").write_bytes(b"half")
    (inbox / "old.mcap").write_bytes(b"something")
    now = time.time_ns()
    assert [path.name for path in arrivals(inbox, 5.0, now + 10 * 10**9).complete] == ["old.mcap", "whole"]
    assert arrivals(inbox, 60.0, now).complete == ()
    with (inbox / "old.mcap").open("ab"):
        found = arrivals(inbox, 5.0, now + 10 * 10**9)
    assert [path.name for path in found.complete] == ["whole"]
    assert {path.name: reason for path, reason in found.waiting} == {
        "copied": "image9.png.part is half copied",
        "sent.mcap.filepart": "sent.mcap.filepart is half copied",
        "old.mcap": "old.mcap is open for writing",
    }
    with pytest.raises(UsageError, match="not a folder"):
        arrivals(tmp_path / "nowhere", 0.0, now)


def test_one_night_at_a_time_and_a_dead_one_holds_nothing(hall: Path) -> None:
    with MapStore.open(hall / "store", create=True):
        pass
    lock = hall / "store/nightly-hall.lock"
    with within_another_process(locked, lock, shared=False), pytest.raises(BusyError, match="holds"):
        spend(hall)
    with MapStore.open(hall / "store") as maps:
        assert maps.jobs("hall") == []
    assert "version 1 published" in spend(hall)


@pytest.mark.parametrize("how", ["kill", "ENOSPC"])
def test_a_night_that_was_killed_or_ran_out_of_space_is_gone_on_with(hall: Path, how: str, tmp_path_factory) -> None:
    """At every 23rd file-system call, SQLite's too: the next night makes one version of both recordings, and loses nothing."""
    number, tries, resumed = 4 if how == "kill" else 7, 0, 0
    while True:
        folder = tmp_path_factory.mktemp("night")
        shutil.copytree(hall / "inbox", folder / "inbox")
        disk = Disk(f"{folder}/", number, how, is_lasting=how == "ENOSPC")
        status, disk = in_child(partial(spend, folder), disk, folder.with_suffix(".told"))
        assert status in ((9, 0) if how == "kill" else (3, 0)), (status, number)
        number += 23
        if status != 9 and not disk.struck:
            break
        tries += 1
        if (folder / "store/store.sqlite3").is_file():
            with MapStore.open(folder / "store") as maps:
                resumed += any(job.state == "running" for job in maps.jobs())
        spend(folder)
        assert states(folder) == [("current", ["monday", "tuesday"])], number
        assert names(folder / "inbox/done") == ["monday", "tuesday"], number
        assert names(folder / "inbox") == ["done"]
        with MapStore.open(folder / "store") as maps:
            assert maps.verify().faults == []
            assert {job.state for job in maps.jobs("hall")} <= {"done", "failed"}
    assert tries > 6
    assert resumed > 2


def test_a_draft_that_a_killed_night_left_is_published_without_building_again(hall: Path, monkeypatch) -> None:
    with patch.object(releases, "publish", side_effect=CancelledError), pytest.raises(CancelledError):  # as if killed
        spend(hall)
    monkeypatch.setattr(night, "build_draft", lambda *_: pytest.fail("built again"))
    assert "version 1 published" in spend(hall)
    assert last_report(hall / "store", "hall")["resumes"] == [1]
    with MapStore.open(hall / "store") as maps:
        assert "was interrupted; job 2 goes on" in maps.job(1).message


def test_the_command_says_how_it_ended(hall: Path, monkeypatch, capsys) -> None:
    def run(*more: str) -> int:
        words = ["nightly", "--site", "hall", "--inbox", hall / "inbox", "--store", hall / "store"]
        return status("mapserver", *words, "--settle-s", "0", *more)

    assert run("--report", str(hall / "night.json")) == 0
    assert "version 1 published" in capsys.readouterr().out
    assert json.loads((hall / "night.json").read_text())["state"] == "done"
    record(hall / "inbox", "wednesday", 3)
    monkeypatch.setattr(night, "build_draft", lambda *a: built(*a, landmarks=10))
    assert run("--report", str(hall / "night.json")) == 4
    assert json.loads((hall / "night.json").read_text())["state"] == "failed"
    assert "number of landmarks" in capsys.readouterr().err


def test_its_report_is_documented() -> None:
    documented = {code_words(row[0])[0] for row in rows(section("docs/reports.md", "Nightly"))}
    assert documented == {*NightReport.__struct_fields__} | {"state", "message"}


def test_a_build_ends_with_its_killed_server(tmp_path: Path) -> None:
    killed = """
import os, signal, sys
from pathlib import Path
from mapserver.serving.night_runs import NightRuns
from mapserver.store import MapStore

folder = Path(sys.argv[1])
(folder / "inbox/lab").mkdir(parents=True)
with MapStore.open(folder / "store", create=True) as store:
    print(NightRuns(store, folder / "inbox")._started("lab", 2).pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""
    server = subprocess.run([sys.executable, "-c", killed, str(tmp_path)], stdout=subprocess.PIPE, check=False)
    build = int(server.stdout)
    while psutil.pid_exists(build) and psutil.Process(build).status() != psutil.STATUS_ZOMBIE:
        time.sleep(0.1)
    with MapStore.open(tmp_path / "store") as store:
        assert [job.state for job in store.jobs("lab")] in ([], ["failed"], ["running"]), "it did not come to its end"
