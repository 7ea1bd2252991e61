"""The process beside a build: what it answers, and that nothing of it outlives its parent."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fleetmap.errors import RecordingError
from mapserver.build import worker as workers
from mapserver.build.worker import SideProcess, open_executor, open_side_process
from mapserver.survey.executor import SERIAL

_PARENT = """
import sys, time
from mapserver.build import worker
worker._is_one_thread = lambda: {forked}
with worker.SideProcess() as side:
    side.submit(time.sleep, 0).result()
    side.submit(time.sleep, 600)
    print(side._process, flush=True)
    time.sleep(600)
"""


@pytest.fixture(params=[True, False], ids=["a copy", "a new process"])
def forked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the process is a copy of this one, as from the command line, or a new one, as where threads run."""
    monkeypatch.setattr(workers, "_is_one_thread", lambda: request.param)
    return bool(request.param)


def refuse(word: str) -> None:
    raise RecordingError(word)


def divided(by: int) -> float:
    return 1 / by


def dies_elsewhere(home: int) -> int:
    if os.getpid() != home:
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def is_gone(process: int) -> bool:
    """Whether it ends within ten seconds."""
    for _ in range(200):
        try:
            if Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.usefixtures("forked")
def test_it_answers_in_order_from_a_process_of_its_own() -> None:
    with SideProcess() as side:
        answers = [side.submit(pow, n, 2) for n in range(4)]
        assert [answer.result() for answer in answers] == [0, 1, 4, 9]
        assert side.submit(os.getpid).result() == side._process != os.getpid()
        assert side.peak_rss_bytes > 1_000_000


@pytest.mark.usefixtures("forked")
def test_errors_come_where_the_result_would() -> None:
    with SideProcess() as side:
        with pytest.raises(RecordingError, match="damaged"):
            side.submit(refuse, "damaged").result()
        with pytest.raises(ZeroDivisionError):
            side.submit(divided, 0).result()
        assert side.submit(divided, 2).result() == 0.5
        assert side.submit(os.getpid).result() == side._process


@pytest.mark.usefixtures("forked")
def test_what_it_dies_of_is_done_here() -> None:
    with SideProcess() as side:
        assert [side.submit(dies_elsewhere, os.getpid()).result() for _ in range(2)] == [os.getpid()] * 2
        assert is_gone(side._process)


@pytest.mark.usefixtures("forked")
def test_leaving_ends_it_in_the_middle_of_work() -> None:
    started_s, shared = time.monotonic(), set(Path("/dev/shm").iterdir())
    with SideProcess() as side:
        waiting = [side.submit(time.sleep, 600) for _ in range(2)]
        side_process = side._process
    assert is_gone(side_process)
    assert all(isinstance(work.exception(), workers.CancelledError) or work.cancelled() for work in waiting)
    assert time.monotonic() - started_s < 60
    assert set(Path("/dev/shm").iterdir()) <= shared


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_it_ends_with_its_parent(forked: bool, end: signal.Signals) -> None:
    program = _PARENT.format(forked=forked)
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    ) as parent:
        assert parent.stdout is not None
        side_process = int(parent.stdout.readline())
        os.killpg(parent.pid, end)  # as a terminal does on Ctrl-C
        assert parent.wait(60) != 0
    assert is_gone(side_process)


def test_one_core_has_none() -> None:
    with open_side_process(1) as side, open_executor(1, None, side) as executor:
        assert side is None
        assert executor is SERIAL
        assert executor.beside(pow, 2, 2) is None


def no_room(*_: object, **__: object) -> int:
    raise BlockingIOError(11, "Resource temporarily unavailable")


@pytest.mark.parametrize("begin", ["fork", "posix_spawn"])
def test_without_room_for_a_process_there_is_none(forked: bool, begin: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers.os, begin, no_room)
    with open_side_process(2) as side:
        assert (side is None) == (forked == (begin == "fork"))
