"""Programs over strangers' files end within their limits, with all that they started, and reach nobody."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fleetmap.errors import FleetmapError
from mapserver.fleet import bounded_process
from mapserver.fleet.bounded_process import ProcessLimits, run_bounded, without_network

LIMITS = ProcessLimits(memory_bytes=1 << 30, cpu_s=2, wall_s=60.0, file_bytes=1 << 20, open_files=32)


def run(program: str, limits: ProcessLimits = LIMITS) -> "subprocess.CompletedProcess[str]":
    return run_bounded([sys.executable, "-c", program], limits, "the replay of failure 1")


@pytest.mark.parametrize(
    ("program", "limits"),
    [
        ("while True: pass", LIMITS._replace(cpu_s=1)),
        ("import time; time.sleep(60)", LIMITS._replace(wall_s=0.5)),
        ("import os; os.kill(os.getpid(), 11)", LIMITS),
    ],
    ids=["processor time", "time", "a fault of its own"],
)
def test_it_is_ended(program: str, limits: ProcessLimits) -> None:
    with pytest.raises(FleetmapError, match="the replay of failure 1 was ended"):
        run(program, limits)


@pytest.mark.parametrize(
    ("program", "error"),
    [
        ("bytearray(2 << 30)", "MemoryError"),
        ("print('x' * (2 << 20))", "File too large"),
        ("files = [open('/dev/null') for _ in range(64)]", "Too many open files"),
    ],
)
def test_it_gets_no_more(program: str, error: str) -> None:
    ended = run(program)
    assert ended.returncode == 1
    assert error in ended.stderr
    assert len(ended.stdout) <= LIMITS.file_bytes


def test_what_it_says_comes_back() -> None:
    ended = run("import sys; print('answer'); print('words', file=sys.stderr); sys.exit(3)")
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, "answer\n", "words\n")


def test_what_it_started_ends_with_it(tmp_path: Path) -> None:
    """A process of its group that holds a pipe: the pipe ends when it does."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        run(f"import subprocess; subprocess.Popen(['sleep', '600'], stdout=open({str(pipe)!r}, 'w'))")
        os.set_blocking(reader, True)
        assert os.read(reader, 1) == b""
    finally:
        os.close(reader)


@pytest.mark.skipif(not without_network(), reason="this system gives no network namespaces to this account")
def test_it_reaches_no_network() -> None:
    ended = run("import socket; print(len(socket.if_nameindex())); socket.create_connection(('192.0.2.1', 80), 1)")
    assert ended.stdout == "1\n", "loopback alone"
    assert "Network is unreachable" in ended.stderr
    assert ended.args[0] != sys.executable


def test_a_system_without_namespaces_says_so(monkeypatch) -> None:
    monkeypatch.setattr(bounded_process.shutil, "which", lambda _: "/bin/false")
    assert without_network() == []
    assert run("pass").args[0] == sys.executable
