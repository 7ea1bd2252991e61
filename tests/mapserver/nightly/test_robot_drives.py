"""Drives that robots hand in: bounded, wanted, and in the inbox as a whole."""

import errno
import os
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fleetmap.errors import LinkError, StateError, StoreError
from fleetmap.failure_summary import MAX_DRIVE_BYTES, ReplayPart
from mapserver.fleet.building import ask_for_survey, end_request
from mapserver.floor_plan.survey_requests import courses
from mapserver.nightly import robot_drives, upload
from mapserver.nightly.robot_drives import RobotDrives
from mapserver.nightly.upload import remove_unfinished
from mapserver.store import Actor, MapStore
from support.fleet.dashboard_scene import SITE, fill_store

ADA = Actor("ada", "new racks")
AISLE = [(14.0, 2.0), (20.0, 2.0), (20.0, 10.0), (14.0, 10.0)]
DATA = bytes(range(256)) * 40


class Scene:
    def __init__(self, folder: Path) -> None:
        fill_store(folder / "store")
        self.store, self.inbox, self.started = MapStore.open(folder / "store"), folder / "inbox", list[str]()
        self.request = ask_for_survey(self.store, SITE, AISLE, ADA).id
        self.drives = self.server()

    def server(self) -> RobotDrives:
        nights: Any = SimpleNamespace(inbox=self.inbox, start=self._start)
        return RobotDrives(self.store, nights)

    def _start(self, site: str) -> None:
        self.started.append(site)
        raise StateError("a build runs already")

    def send(
        self, robot: str = "r1", name: str = "ab12ab12", *, data: bytes = DATA, until: int = 1 << 30, **other: object
    ):
        """Parts of 4 kB, the answers' lengths or the refusal."""
        lengths: list[int | str] = []
        for offset in range(0, min(len(data), until), 4096):
            fields = {"survey": self.request, "total_bytes": len(data)} | other
            part = ReplayPart(id=name, offset=offset, data=data[offset : offset + 4096], **fields)  # type: ignore[arg-type]
            ack = self.drives.take(SITE, robot, part)
            lengths.append(ack.refused or ack.received_bytes)
        return lengths

    def arrived(self) -> list[str]:
        return sorted(path.name for path in self.inbox.rglob("*") if path.is_file())


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def test_a_drive_lands_whole_and_is_built(scene: Scene, monkeypatch) -> None:
    assert scene.send(until=4096) == [4096]
    scene.drives.build()
    (part,) = scene.arrived()
    assert re.fullmatch(rf"\.survey-{scene.request}-r1-ab12ab12\.mcap\.[0-9a-f]{{8}}\.upload\.part", part)
    assert scene.started == []
    assert scene.send() == [4096, 8192, len(DATA)], "a part that comes twice changes nothing"
    assert scene.arrived() == [f"survey-{scene.request}-r1-ab12ab12.mcap"]
    assert (scene.inbox / SITE / scene.arrived()[0]).read_bytes() == DATA
    monkeypatch.setattr(robot_drives, "SETTLE_S", 0.0)
    (scene.inbox / SITE / "drive.mcap").write_bytes(b"of an operator: waits for the night")
    scene.drives.build()
    assert scene.started == [SITE]
    (course,) = courses((e.stamp_ns, e.kind, e.detail) for e in scene.store.events(SITE))
    assert (course.robots, course.driven_ns > course.asked_ns, course.used_ns) == (["r1"], True, 0)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"survey": "00000000"}, "not requested"),
        ({"name": "../../x"}, "not a drive"),
        ({"total_bytes": MAX_DRIVE_BYTES + 1}, "not a drive"),
    ],
)
def test_what_nobody_asked_for_is_refused(scene: Scene, fields: dict[str, Any], words: str) -> None:
    assert words in str(scene.send(**fields)[0])
    assert scene.arrived() == []


def test_a_closed_request_takes_no_more(scene: Scene) -> None:
    scene.send(until=4096)
    end_request(scene.store, SITE, scene.request, ADA)
    assert "not requested any more" in str(scene.send()[0])


def test_a_lost_last_answer_sends_nothing_again(scene: Scene, monkeypatch) -> None:
    """Neither at the same server, nor at another one or a restarted one, nor once the night has moved the recording."""
    scene.send()
    last = ReplayPart(id="ab12ab12", total_bytes=len(DATA), offset=8192, data=DATA[8192:], survey=scene.request)
    assert [each.take(SITE, "r1", last).received_bytes for each in (scene.drives, scene.server())] == [len(DATA)] * 2
    next(scene.inbox.rglob("survey-*")).unlink()
    assert scene.server().take(SITE, "r1", last).received_bytes == len(DATA)
    assert scene.send("r2", until=4096) == [4096], "the same id of another robot is another drive"
    log, away = scene.store.audit, iter([True])

    def lost(*words: Any, **more: Any) -> None:
        if next(away, False):
            raise StoreError("the database does not answer")
        log(*words, **more)

    monkeypatch.setattr(scene.store, "audit", lost)
    with pytest.raises(StoreError):
        scene.send("r3")
    assert scene.drives.take(SITE, "r3", last).received_bytes == len(DATA)
    (course,) = courses((e.stamp_ns, e.kind, e.detail) for e in scene.store.events(SITE))
    assert course.robots == ["r1", "r3"]


def test_a_robot_that_changes_to_another_server_begins_again(scene: Scene) -> None:
    other = scene.server()
    scene.send(until=4096)
    first, scene.drives = scene.drives, other
    assert scene.send(until=4096) == [4096]
    remove_unfinished(scene.inbox)
    assert len(scene.arrived()) == 2, "a server that starts removes nothing of those that run"
    assert scene.send() == [4096, 8192, len(DATA)]
    scene.drives = first
    scene.send("r2", name="cdcdcdcd")
    assert [path.read_bytes() for path in scene.inbox.rglob("survey-*")] == [DATA] * 2


@pytest.mark.parametrize("fault", [errno.ENOSPC, errno.EIO])
def test_what_the_disk_refuses_is_sent_again(scene: Scene, monkeypatch, fault: int) -> None:
    write, calls = os.write, iter(range(100))

    def written(descriptor: int, data: bytes) -> int:
        if next(calls) == 1:
            write(descriptor, data[:100])
            raise OSError(fault, os.strerror(fault))
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", written)
    with pytest.raises(LinkError, match=r"later: .*cannot be written"):
        scene.send()
    assert scene.arrived() == []
    assert scene.send() == [4096, 8192, len(DATA)]
    assert (scene.inbox / SITE / scene.arrived()[0]).read_bytes() == DATA


def test_a_disk_that_gets_full_in_the_middle_loses_no_drive(scene: Scene, monkeypatch) -> None:
    scene.send(until=4096)
    with monkeypatch.context() as patch:
        patch.setattr(upload, "_KEPT_SHARE", 0.001)
        patch.setattr(upload, "_KEPT_BYTES", 1 << 60)
        with pytest.raises(LinkError, match=r"later: .*the disk has room"):
            scene.send()
    assert scene.send()[-1] == len(DATA)


def test_many_names_are_one_site_and_one_request(scene: Scene, monkeypatch) -> None:
    monkeypatch.setattr(robot_drives, "MOST_OF_A_REQUEST", 3)
    for number in range(3):
        assert scene.send(f"r{number}")[-1] == len(DATA)
    for server in (scene.drives, scene.server()):
        scene.drives = server
        assert scene.send("r3", until=4096) == ["3 drives were handed in for its survey already"]
    assert len(scene.arrived()) == 3
    monkeypatch.setattr(robot_drives, "SITE_BURST", 2)
    scene.request, scene.drives = ask_for_survey(scene.store, SITE, AISLE, ADA).id, scene.server()
    scene.send("r1"), scene.send("r2")
    with pytest.raises(LinkError, match="one in ten minutes"):
        scene.send("r3")


def test_what_a_silent_robot_has_sent_does_not_stay(scene: Scene, monkeypatch) -> None:
    scene.send(until=4096)
    scene.drives.build()
    assert len(scene.arrived()) == 1
    monkeypatch.setattr(robot_drives, "_IDLE_NS", -1)
    scene.drives.build()
    assert scene.arrived() == []


def test_robots_are_bounded(scene: Scene) -> None:
    for number in range(robot_drives.DRIVE_BURST):
        scene.send(name=f"{number:08x}")
    with pytest.raises(LinkError, match="one in twenty minutes"):
        scene.send(name="ffffffff")
    for number in range(4):
        scene.send(f"s{number}", until=4096)
    with pytest.raises(LinkError, match="4 robots"):
        scene.send("s4", until=4096)
    begun_again = ReplayPart(id="cdcdcdcd", total_bytes=9999, offset=4096, data=b"x", survey=scene.request)
    assert scene.drives.take(SITE, "s9", begun_again).received_bytes == 0
