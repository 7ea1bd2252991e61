"""Alerts as JSON to a webhook, in the form of Prometheus Alertmanager (version 4), so that its receivers take them.

The receiver is not trusted: only the status of its response is read, redirects are not followed, and each attempt has a time
limit. Messages are sent by a separate thread, so that callers are not blocked.
"""

import http.client
import logging
import queue
import socket
import ssl
import threading
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from fleetmap.bus.endpoints import is_loopback_name
from fleetmap.encoding import to_json
from fleetmap.errors import StateError, UsageError, disk_errors
from fleetmap.log_lines import LogLimit
from mapserver.fleet.alerts import AlertSettings, Incident
from mapserver.store import Event

_ATTEMPT_S = 5.0
_PAUSES_S = (2.0, 10.0, 60.0)  # between four attempts
_MOST_WAITING = 50
_MOST_ALERTS = 200  # in one message
_log = logging.getLogger(__name__)
Body = dict[str, Any]


class Webhook:
    """Sends messages in order until `close`; those that wait too long or fail four times are dropped and logged. host: the receiver's."""

    def __init__(self, settings: AlertSettings) -> None:
        """UsageError for a forbidden address or an unreadable token."""
        address = check_address(settings.webhook or "")
        self._secure, self.host, self._port = address.scheme == "https", address.hostname or "", address.port
        self._path = f"{address.path or '/'}{f'?{address.query}' if address.query else ''}"
        self._headers = {"Content-Type": "application/json", "User-Agent": "fleetmap"}
        if settings.token_file is not None:
            self._headers["Authorization"] = f"Bearer {_token(Path(settings.token_file))}"
        self._known, self._rung = dict[str, Incident](), dict[str, Incident]()
        self._waiting: queue.Queue[bytes] = queue.Queue(_MOST_WAITING)
        self._ended = threading.Event()
        self._refusals = LogLimit(_log)
        self._testing = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="webhook", daemon=True)
        self._thread.start()

    def tell(self, alerts: Sequence[Incident], acts: Sequence[Event], now_ns: int) -> None:
        """Send what is new among the active alerts, what has ended, and what people did about incidents. After a restart of the server
        active ones are sent again, but for those that somebody acknowledged or closed.
        """
        now = {alert.id: self._known.get(alert.id, alert) for alert in alerts}
        rings = {alert.id: now[alert.id] for alert in alerts if alert.state == "open"}
        begun = [alert for key, alert in rings.items() if key not in self._rung]
        ended = [alert for key, alert in self._known.items() if key not in now]
        self._known, self._rung = now, rings
        for status, changed in (("firing", begun), ("resolved", [*ended, *map(_told, acts)])):
            if changed:
                self.put(message(changed[:_MOST_ALERTS], status, now_ns))
            if len(changed) > _MOST_ALERTS:
                _log.warning("%d alerts at once; only the first %d are sent", len(changed), _MOST_ALERTS)

    def put(self, body: Body) -> None:
        try:
            self._waiting.put_nowait(to_json(body))
        except queue.Full:
            self._refusals.warning("full", "an alert is dropped: the queue of the webhook is full (%d)", _MOST_WAITING)

    def test(self, now_ns: int) -> tuple[bool, str]:
        """Send a test alert once, and wait: whether the receiver accepted it, and its answer. StateError while another is under way."""
        test = Incident("FleetmapTest", "", "", now_ns, "A test of the webhook. Nothing is wrong.")
        if not self._testing.acquire(blocking=False):
            raise StateError("another test alert is on its way; wait for its answer")
        try:
            is_accepted, answer = self._attempt(to_json(message([test], "firing", now_ns)))
        finally:
            self._testing.release()
        return is_accepted, f"{self.host} {'accepted' if is_accepted else 'did not accept'} the test alert: {answer}"

    def close(self) -> None:
        self._ended.set()
        self._thread.join(_ATTEMPT_S + 1.0)

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                body = self._waiting.get(timeout=0.2)
            except queue.Empty:
                continue
            self._deliver(body)

    def _deliver(self, body: bytes) -> None:
        for pause_s in (*_PAUSES_S, None):
            is_accepted, answer = self._attempt(body)
            if is_accepted:
                return
            self._refusals.warning("fault", "the webhook at %s did not accept an alert: %s", self.host, answer)
            if pause_s is not None and self._ended.wait(pause_s):
                return
        self._refusals.warning("dropped", "an alert is dropped: the webhook refused it %d times", len(_PAUSES_S) + 1)

    def _attempt(self, body: bytes) -> tuple[bool, str]:
        """Send once: whether the receiver accepted it, and its status or what went wrong."""
        made = http.client.HTTPConnection(self.host, self._port or (443 if self._secure else 80), timeout=_ATTEMPT_S)
        # A socket timeout restarts with each byte: a receiver that sends single bytes would block this thread for ever.
        watch = threading.Timer(_ATTEMPT_S, _cut, (made,))
        try:
            made.connect()
            if self._secure:
                tls = ssl.create_default_context()
                made.sock = tls.wrap_socket(made.sock, server_hostname=self.host, do_handshake_on_connect=False)
            watch.start()
            if isinstance(made.sock, ssl.SSLSocket):
                made.sock.do_handshake()
            made.request("POST", self._path, body, self._headers)
            status = made.getresponse().status
        except Exception as error:  # after any error the next alert is still tried
            return False, f"{type(error).__name__}: {error}"[:200]
        finally:
            watch.cancel()
            made.close()
        return 200 <= status < 300, f"status {status}"


def _told(act: Event) -> Incident:
    """An act as an alert that is over: nobody is called for it."""
    done, _, incident = act.detail.partition(": ")
    words = f"{incident} {done} by {act.actor}{f': {act.reason}' if act.reason else ''}"
    return Incident("FleetmapIncident", act.site, incident, act.stamp_ns, words)


def message(alerts: Sequence[Incident], status: str, now_ns: int) -> Body:
    """Return alerts of one status, in the format of Alertmanager's webhooks."""
    told = [
        {
            "status": status,
            "labels": {"alertname": alert.name, "site": alert.site, **({"about": alert.about} if alert.about else {})},
            "annotations": {"summary": alert.words},
            "startsAt": _moment(alert.since_ns),
            "endsAt": _moment(now_ns) if status == "resolved" else "0001-01-01T00:00:00Z",
        }
        for alert in alerts
    ]
    return {"version": "4", "receiver": "fleetmap", "status": status, "truncatedAlerts": 0, "alerts": told}


def check_address(webhook: str) -> Any:
    """Return the parts of a webhook's address; UsageError without https to another machine, or with a password."""
    try:
        parts = urlsplit(webhook)
        host, _ = parts.hostname, parts.port
    except ValueError as error:
        raise UsageError(f"[alerts] webhook = {webhook[:200]!r}: {error}") from error
    if parts.scheme not in {"https", "http"} or not host or any(c.isspace() or not c.isprintable() for c in webhook):
        raise UsageError(f"[alerts] webhook = {webhook[:200]!r}: write it like https://alerts.example/fleetmap")
    if parts.username is not None or parts.password is not None:
        raise UsageError("[alerts] webhook holds a name or password; put a token into a file and name it in token_file")
    if parts.scheme == "http" and not is_loopback_name(host):
        raise UsageError(f"[alerts] webhook = {webhook[:200]!r}: for another machine use https://")
    return parts


def _token(path: Path) -> str:
    with disk_errors(f"[alerts] token_file = {path} cannot be read", "check the path and its rights", UsageError):
        token = path.read_text("utf-8").strip()
    if not token.isascii() or not token.isprintable() or not 1 <= len(token) <= 4096:
        raise UsageError(f"[alerts] token_file = {path}: it must hold one line of ASCII")
    return token


def _cut(connection: http.client.HTTPConnection) -> None:
    with suppress(OSError, AttributeError):  # it was closed meanwhile, and has no socket
        connection.sock.shutdown(socket.SHUT_RDWR)


def _moment(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).isoformat().replace("+00:00", "Z")
