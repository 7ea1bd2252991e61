"""Runs a program on an untrusted file: with limits, without a network if possible, and killed with its process group."""

import os
import resource
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from tempfile import TemporaryFile
from typing import NamedTuple

from fleetmap.errors import FleetmapError, StateError

_NO_NETWORK = ("--map-current-user", "--net", "--")


class ProcessLimits(NamedTuple):
    """Of one process: address space, CPU time, wall time, size of each written file (output included), and open files."""

    memory_bytes: int = 4 << 30
    cpu_s: int = 600
    wall_s: float = 900.0
    file_bytes: int = 64 << 20
    open_files: int = 256

    def apply(self, process_id: int) -> None:
        for kind, wanted in (
            (resource.RLIMIT_AS, self.memory_bytes),
            (resource.RLIMIT_CPU, self.cpu_s),
            (resource.RLIMIT_FSIZE, self.file_bytes),
            (resource.RLIMIT_NOFILE, self.open_files),
            (resource.RLIMIT_CORE, 0),
        ):
            hard = resource.getrlimit(kind)[1]
            limit = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
            resource.prlimit(process_id, kind, (limit, limit))


def client_command(*words: object) -> list[str]:
    """Return a command of the robots' client, which the server does not import (ARCHITECTURE.md); StateError if it is missing."""
    if find_spec("locclient") is None:
        raise StateError("the robots' client is not installed; install the distribution `fleetmap` as a whole")
    return [sys.executable, "-m", "locclient.cli", *map(str, words)]


def without_network() -> list[str]:
    """Return the command prefix that removes the network; empty if the system refuses it for this account."""
    unshare = shutil.which("unshare")
    if unshare is None:
        return []
    words = [unshare, *_NO_NETWORK]
    asked = subprocess.run([*words, "true"], stdin=subprocess.DEVNULL, capture_output=True, check=False)
    return words if asked.returncode == 0 else []


def run_bounded(command: list[str], limits: ProcessLimits, what: str) -> "subprocess.CompletedProcess[str]":
    """Run a command within limits, `without_network` where the system allows it.

    FleetmapError, naming `what`, if it is killed by a limit or crashes.
    """
    whole = [*without_network(), *command]
    with TemporaryFile() as output, TemporaryFile() as errors:
        process = subprocess.Popen(
            whole, stdin=subprocess.DEVNULL, stdout=output, stderr=errors, start_new_session=True
        )
        try:
            limits.apply(process.pid)  # not between fork and exec, where another thread's lock is never released
            status = process.wait(limits.wall_s)
        except subprocess.TimeoutExpired as error:
            raise FleetmapError(f"{what} was ended after {limits.wall_s:.0f} s; report it with its file") from error
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        for file in (output, errors):
            file.seek(0)
        said, complained = (file.read(limits.file_bytes).decode("utf-8", "replace") for file in (output, errors))
    if status < 0:
        most = f"{limits.memory_bytes >> 20} MiB or {limits.cpu_s} s of processor time"
        raise FleetmapError(
            f"{what} was ended by {signal.Signals(-status).name}: it took more than {most}, or crashed the program; "
            "report it with the recording"
        )
    return subprocess.CompletedProcess(whole, status, said, complained)
