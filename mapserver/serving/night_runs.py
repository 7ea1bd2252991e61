"""Nightly runs that operators start now: a process of `mapserver nightly` that ends with the server.

A run is made to be interrupted: the next one continues it. So it need not outlive the server, which a service manager or a container
would not allow anyway; and after a stop of the server nothing works on, unseen.
"""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile

from fleetmap.errors import FleetmapError, StateError, StoreError, disk_errors
from fleetmap.hooks import plugins
from mapserver.store import JobInfo, MapStore

SETTLE_S = 5.0  # an operator who starts a run now has just copied something
_BEGIN_WITHIN_S = 60.0
_STOP_WITHIN_S = 3.0
_NICE = 10  # robots are served first
_LOG_BYTES = 4000
_log = logging.getLogger(__name__)


class NightRuns:
    """Starts runs, one at a time. inbox: the folder with a folder for each site; config: the server's configuration file."""

    def __init__(self, store: MapStore, inbox: Path, config: Path | None = None) -> None:
        self._store, self.inbox, self._config = store, inbox, config
        self._lock = threading.Lock()
        self._run: tuple[str, subprocess.Popen[bytes]] | None = None
        self._input, self._kept_open = os.pipe()

    def start(self, site: str, log: Callable[[], None] = lambda: None) -> JobInfo:
        """Start a run of a site and return its job, once it has one. log: called right before the run begins.

        Raises StateError while a run of this server goes on, FleetmapError with the message of a run that ends without a job.
        """
        if not self._lock.acquire(blocking=False):
            raise StateError("another build is being started; try again in a minute")
        try:
            return self._begun(site, log)
        finally:
            self._lock.release()

    def _begun(self, site: str, log: Callable[[], None]) -> JobInfo:
        if self._run is not None and self._run[1].poll() is None:
            raise StateError(f"a build of site {self._run[0]} runs already; start this one when it has ended")
        with disk_errors("a build cannot be started", "see the space of the disk with temporary files"):
            file = TemporaryFile()  # noqa: SIM115  closed below
        with file as errors:
            log()
            last = max((job.id for job in self._store.jobs(site, limit=1)), default=0)
            process = self._started(site, errors.fileno())
            self._run = site, process
            until_s = time.monotonic() + _BEGIN_WITHIN_S
            while time.monotonic() < until_s:
                is_ended = process.poll() is not None
                if (job := self._job(site)) is not None and job.id > last:
                    return job
                if is_ended:
                    errors.seek(0)
                    words = errors.read(_LOG_BYTES).decode("utf-8", "replace").strip()
                    raise StateError(words or f"the build ended with status {process.returncode}; try it again")
                time.sleep(0.1)
        raise StoreError(
            f"the build did not begin its job within {_BEGIN_WITHIN_S:.0f} s; the list of jobs shows it later"
        )

    def close(self) -> None:
        """End a run as Ctrl-C does, or kill it; its recordings stay in the inbox, and the next run continues."""
        if self._run is None or self._run[1].poll() is not None:
            return
        site, process = self._run
        _log.info("the build of site %s is stopped; the next one continues it", site)
        process.send_signal(signal.SIGINT)
        try:
            process.wait(_STOP_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            with suppress(FleetmapError):  # it was not killed by a recording
                if (job := self._job(site)) is not None:
                    self._store.tell_progress(job.id, [], "looking_at")

    def _job(self, site: str) -> JobInfo | None:
        return next((job for job in self._store.jobs(site, limit=1) if job.kind == "nightly"), None)

    def _started(self, site: str, errors: int) -> "subprocess.Popen[bytes]":
        if "nightly" not in plugins("mapserver.commands"):
            raise StateError("a build needs a plug-in that is not installed: entry point nightly of mapserver.commands")
        config = [] if self._config is None else ["--config", str(self._config)]
        folders = ["--inbox", str(self.inbox / site), "--store", str(self._store.folder)]
        command = [sys.executable, "-m", "mapserver.end_with_server", *config, "nightly", "--site", site, *folders]
        command += ["--settle-s", f"{SETTLE_S:g}"]
        with disk_errors("a build cannot be started", "see the memory of this machine", FleetmapError):
            process = subprocess.Popen(
                command,
                stdin=self._input,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                start_new_session=True,  # Ctrl-C in the server's terminal is passed on by `close`
                env=os.environ | {"COLUMNS": "200"},
            )
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
            Path(f"/proc/{process.pid}/oom_score_adj").write_text("1000", "ascii")  # before the server
        return process
