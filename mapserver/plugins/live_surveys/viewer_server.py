"""Foxglove's websocket server: sends messages to subscribed viewers and never waits for one."""

import logging
import threading
from collections import deque
from collections.abc import Iterable
from typing import Self

import foxglove
from foxglove import Channel, Context
from foxglove.websocket import ChannelView, Client, ServerListener

from fleetmap.errors import FleetmapError, UsageError
from fleetmap.log_lines import LogLimit
from fleetmap.plugins.viewer_channels.channels import CHANNELS, Shown, encoding_of

_WAITING = 32  # messages of a topic that are not encoded yet
_BACKLOG = 256  # encoded messages waiting for one viewer; the library drops the oldest
_STOP_WITHIN_S = 1.0
_log = logging.getLogger(__name__)


class FoxgloveServer:
    """Encodes and sends in a thread of its own; methods may be called from any thread. Use it in `with`.

    A new viewer gets the last message of each topic. dropped: number of messages that arrived too fast to be encoded.
    """

    def __init__(self, host: str, port: int, name: str) -> None:
        """host, port: for viewers; name: shown by viewers. Raises UsageError if it cannot listen there."""
        self.dropped = 0
        self._context = Context()
        # All before any viewer connects: an early subscription to a channel that is created later may be refused as unknown.
        self._channels = {
            topic: Channel(topic, schema=schema, message_encoding=encoding_of(schema), context=self._context)
            for topic, schema in CHANNELS.items()
        }
        self._waiting: dict[str, deque[Shown]] = {}
        self._last: dict[str, Shown] = {}
        self._subscribed: deque[str] = deque()  # without a lock: the library holds its own during the call
        self._lock, self._wake, self._ended = threading.Lock(), threading.Event(), False
        self._faults = LogLimit(_log)
        try:
            self._server = foxglove.start_server(
                name=name,
                host=host,
                port=port,
                server_listener=_Listener(self),
                message_backlog_size=_BACKLOG,
                context=self._context,
            )
        except (RuntimeError, OSError) as error:
            raise UsageError(f"--foxglove {host}:{port}: cannot listen there ({error}); choose another") from error
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{self._server.port}"
        self._thread = threading.Thread(target=self._serve, daemon=True, name="foxglove")
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        self._wake.set()
        self._thread.join()
        # The library waits until each viewer has taken its messages, and a hanging viewer never does.
        stopping = threading.Thread(target=self._server.stop, daemon=True, name="foxglove stops")
        stopping.start()
        stopping.join(_STOP_WITHIN_S)
        if self.dropped:
            _log.warning("%d messages came too quickly for the viewers and were dropped", self.dropped)

    def wants(self, topic: str) -> bool:
        """True if a viewer subscribes to the topic; check it before making expensive messages."""
        return self._channels[topic].has_sinks()

    def show(self, some: Iterable[Shown]) -> None:
        """Queue messages, in order for each topic; returns at once. The oldest are dropped if too many wait."""
        with self._lock:
            for shown in some:
                waiting = self._waiting.setdefault(shown.topic, deque(maxlen=_WAITING))
                self.dropped += len(waiting) == _WAITING
                waiting.append(shown)
        self._wake.set()

    def subscribed(self, topic: str) -> None:
        """Handle a viewer's subscription to a topic."""
        self._subscribed.append(topic)
        self._wake.set()

    def _serve(self) -> None:
        """Encode and publish, outside the library's callbacks, which must not publish."""
        while not self._ended:
            self._wake.wait()
            self._wake.clear()
            topics = {self._subscribed.popleft() for _ in range(len(self._subscribed))}
            late = [self._last[topic] for topic in sorted(topics) if topic in self._last]
            with self._lock:
                fresh = [shown for waiting in self._waiting.values() for shown in waiting]
                self._waiting.clear()
            self._publish(late)
            self._publish(fresh)

    def _publish(self, some: Iterable[Shown]) -> None:
        for shown in some:
            self._last[shown.topic] = shown
            channel = self._channels[shown.topic]
            if not channel.has_sinks():
                continue
            try:
                message = shown.make()
            except FleetmapError as error:
                self._faults.warning(shown.topic, "%s cannot be shown: %s", shown.topic, error)
                continue
            except Exception:  # an error in one message must not stop the others
                _log.exception("%s cannot be shown", shown.topic)
                continue
            channel.log(message.data, log_time=max(0, message.stamp_ns))


class _Listener(ServerListener):
    """Callbacks of the library, called from its own threads."""

    def __init__(self, server: FoxgloveServer) -> None:
        self._server = server

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """See the library's ServerListener."""
        self._server.subscribed(channel.topic)
