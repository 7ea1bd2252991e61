"""Messages to systemd, and the file that `locclient status` reads."""

import re
import socket
import time
from pathlib import Path

import pytest

from locclient.daemon.service_manager import ServiceManager
from support.command_line import status

Said = pytest.CaptureFixture[str]


@pytest.mark.parametrize("abstract", [False, True])
def test_the_manager_is_told(tmp_path: Path, abstract: bool) -> None:
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind("\0" + path if abstract else path)
        listener.settimeout(5)
        manager = ServiceManager("@" + path if abstract else path)
        manager.ready()
        manager.alive("TRACKING")
        manager.stopping()
        assert [listener.recv(100) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1\nSTATUS=TRACKING", b"STOPPING=1"]


@pytest.mark.timeout(30)
def test_a_manager_that_does_not_read_holds_nothing_up(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        manager = ServiceManager(str(tmp_path / "notify"))
        for _ in range(2000):  # far more than the system keeps of them
            manager.alive("TRACKING")


def test_without_a_manager_or_a_folder_nothing_happens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    for manager in (ServiceManager(), ServiceManager(str(tmp_path / "gone"), tmp_path / "gone")):
        manager.ready()
        manager.alive("TRACKING")
        manager.stopping()


def asked(monkeypatch: pytest.MonkeyPatch, folder: Path) -> int:
    monkeypatch.setenv("RUNTIME_DIRECTORY", f"{folder}:/somewhere/else")
    return status("locclient", "status")


def test_what_the_daemon_says_can_be_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said) -> None:
    assert asked(monkeypatch, tmp_path) == 3
    assert re.search(r"no daemon has written .*; start `locclient run`", capsys.readouterr().err)
    manager = ServiceManager()
    manager.alive("AMBIGUOUS")
    manager.alive("TRACKING")
    assert asked(monkeypatch, tmp_path) == 0
    assert re.fullmatch(r"TRACKING, 0\.\d s ago\n", capsys.readouterr().out)
    manager.stopping()
    assert asked(monkeypatch, tmp_path) == 3, "a daemon that was stopped says nothing any more"


@pytest.mark.parametrize("now_s", [100.06, 100.04, 62485.199999])
def test_a_status_can_be_read_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, now_s: float) -> None:
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    ServiceManager(folder=tmp_path).alive("TRACKING")
    assert asked(monkeypatch, tmp_path) == 0


@pytest.mark.parametrize(
    ("later_s", "text", "words"),
    [
        (11.0, "{now} TRACKING", "last reported 'TRACKING' 11 s ago; it hangs"),
        (-1e6, "{now} TRACKING", "before this machine was started"),
        (0.0, "nan TRACKING", "last reported"),
        (0.0, "", "holds '', not the status of a daemon"),
        (0.0, "\x00\udcff" * 99, "not the status of a daemon"),
    ],
)
def test_an_old_or_broken_status_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said, later_s: float, text: str, words: str
) -> None:
    now_s = time.monotonic()
    content = text.format(now=now_s).encode("utf-8", "surrogateescape")
    (tmp_path / "status").write_bytes(content)
    monkeypatch.setattr(time, "monotonic", lambda: now_s + later_s)
    assert asked(monkeypatch, tmp_path) == 3
    assert words in capsys.readouterr().err
