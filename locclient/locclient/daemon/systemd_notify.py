"""Notification of systemd (sd_notify): datagrams to the socket named in NOTIFY_SOCKET, none without it."""

import os
import socket


class ServiceManager:
    """Ready, status, watchdog, stopping. Source: the documented protocol of sd_notify(3)."""

    def __init__(self, address: str | None = None) -> None:
        """address: of the socket, that of the environment without it."""
        given = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        self._address = "\0" + given[1:] if given.startswith("@") else given

    def ready(self) -> None:
        """The service is ready."""
        self._tell("READY=1")

    def alive(self, status: str) -> None:
        """Resets the watchdog; status: a line for `systemctl status`."""
        self._tell(f"WATCHDOG=1\nSTATUS={status}")

    def stopping(self) -> None:
        """The service is stopping."""
        self._tell("STOPPING=1")

    def _tell(self, text: str) -> None:
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            try:
                sender.connect(self._address)
                sender.send(text.encode())
            except OSError:
                pass  # nobody listens any more: the service goes on, and its manager will judge by the watchdog
