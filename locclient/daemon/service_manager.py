"""Status of the daemon for systemd, by datagrams (sd_notify), and for `locclient status`, by a file."""

import os
import socket
import time
from contextlib import suppress
from pathlib import Path

from fleetmap.errors import FleetmapError, disk_errors

_FILE = "status"
_SILENT_S = 10.0  # as WatchdogSec of deploy/locclient.service


class ServiceManager:
    """Reports ready, status, watchdog and stopping. Source: the documented protocol of sd_notify(3)."""

    def __init__(self, address: str | None = None, folder: Path | None = None) -> None:
        """address: systemd's socket; folder: that of the status file. Defaults: from the environment."""
        given = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        self._address = "\0" + given[1:] if given.startswith("@") else given
        self._folder = folder or runtime_folder()

    def ready(self) -> None:
        self._tell("READY=1")

    def alive(self, status: str) -> None:
        """Reset the watchdog; status: a line for `systemctl status` and `locclient status`."""
        self._tell(f"WATCHDOG=1\nSTATUS={status}")
        if self._folder is None:
            return
        with suppress(OSError):  # the robot continues, and readers find an old file
            fresh = self._folder / f"{_FILE}.new"
            # Monotonic clock, which is never set. Not rounded: rounded up, it would lie in the future.
            fresh.write_text(f"{time.monotonic()!r} {status}\n", encoding="utf-8")
            fresh.replace(self._folder / _FILE)

    def stopping(self) -> None:
        self._tell("STOPPING=1")
        if self._folder is not None:
            with suppress(OSError):
                (self._folder / _FILE).unlink(missing_ok=True)

    def _tell(self, text: str) -> None:
        if not self._address:
            return
        # If the socket is gone, the service continues, and its manager decides by the watchdog.
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender, suppress(OSError):
            sender.setblocking(False)  # a manager that does not read must not block the robot
            sender.connect(self._address)
            sender.send(text.encode())


def runtime_folder() -> Path | None:
    """Return the first folder of RUNTIME_DIRECTORY; None if unset."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    return Path(given) if given else None


def last_status(folder: Path) -> str:
    """Return the last status of the daemon of this folder, with its age; FleetmapError if older than ten seconds."""
    path = folder / _FILE
    advice = "start `locclient run` with this folder as its RUNTIME_DIRECTORY, as deploy/locclient.service does"
    with disk_errors(f"no daemon has written {path}", advice, FleetmapError):
        said_s, _, status = path.read_text(encoding="utf-8", errors="replace").strip().partition(" ")
    try:
        age_s = time.monotonic() - float(said_s)
    except ValueError as error:
        raise FleetmapError(f"{path} holds {said_s[:40]!r}, not the status of a daemon; {advice}") from error
    if not 0.0 <= age_s <= _SILENT_S:
        when = f"{age_s:.0f} s ago" if age_s > 0.0 else "before this machine was started"
        raise FleetmapError(f"the daemon last reported {status[:80]!r} {when}; it hangs or was killed, see its log")
    return f"{status}, {age_s:.1f} s ago"
