"""Messages to systemd."""

import socket
from pathlib import Path

import pytest

from locclient.daemon.systemd_notify import ServiceManager


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


def test_without_a_manager_nothing_happens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    ServiceManager().ready()
    ServiceManager(str(tmp_path / "gone")).alive("x")
