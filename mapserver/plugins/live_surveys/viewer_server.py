"""A live survey for Foxglove: the growing map, the robot's pose, and the tracked points of its camera.

Its websocket server sends messages to subscribed viewers and never waits for one.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager

import foxglove
import numpy as np
from foxglove import Channel, Context
from foxglove.websocket import ChannelView, Client, ServerListener

from fleetmap.errors import FleetmapError, UsageError
from fleetmap.geometry import Array
from fleetmap.log_lines import LogLimit
from fleetmap.messages import EstimateMessage
from fleetmap.plugins.viewer_channels import channels
from fleetmap.plugins.viewer_channels.channels import BASE, CAMERA, ODOM, SURVEY, ChannelMessage, Shown
from mapserver.plugins.live_surveys.drives import Drive
from mapserver.plugins.live_surveys.live_survey import Tracked
from mapserver.plugins.live_surveys.message import LiveSurveyState

_WAITING = 32  # messages of a topic that are not encoded yet
_BACKLOG = 256  # encoded messages waiting for one viewer; the library drops the oldest
_STOP_WITHIN_S = 1.0
_log = logging.getLogger(__name__)
_IMAGE_EVERY_NS = 200_000_000


class FoxgloveServer(ServerListener, AbstractContextManager["FoxgloveServer"]):
    """Encodes and sends in a thread of its own; methods may be called from any thread. Use it in `with`.

    A new viewer gets the last message of each topic. dropped: number of messages that arrived too fast to be encoded.
    """

    def __init__(self, host: str, port: int, name: str) -> None:
        """host, port: for viewers; name: shown by viewers. Raises UsageError if it cannot listen there."""
        self.dropped = 0
        context = self._context = Context()
        # All before any viewer connects: an early subscription to a channel that is created later may be refused as unknown.
        self._channels = {
            topic: Channel(topic, schema=schema, message_encoding=channels.encoding_of(schema), context=context)
            for topic, schema in channels.CHANNELS.items()
        }
        self._waiting: dict[str, deque[Shown]] = {}
        self._last: dict[str, Shown] = {}
        self._subscribed: deque[str] = deque()  # without a lock: the library holds its own during the call
        self._lock, self._wake, self._ended = threading.Lock(), threading.Event(), False
        self._faults = LogLimit(_log)
        try:
            self._server = foxglove.start_server(
                name=name, host=host, port=port, server_listener=self, message_backlog_size=_BACKLOG, context=context
            )
        except (RuntimeError, OSError) as error:
            raise UsageError(f"--foxglove {host}:{port}: cannot listen there ({error}); choose another") from error
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{self._server.port}"
        self._thread = threading.Thread(target=self._serve, daemon=True, name="foxglove")
        self._thread.start()

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

    def show(self, some: Iterable[Shown]) -> None:
        """Queue messages, in order for each topic; returns at once. The oldest are dropped if too many wait."""
        with self._lock:
            for shown in some:
                waiting = self._waiting.setdefault(shown.topic, deque(maxlen=_WAITING))
                self.dropped += len(waiting) == _WAITING
                waiting.append(shown)
        self._wake.set()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """See ServerListener: the library calls it from its own threads."""
        self._subscribed.append(channel.topic)
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


class LiveViewer:
    """Passes a running survey, seen from above in a separate frame `survey`, to the server, which encodes it: no frame is delayed."""

    def __init__(self, server: FoxgloveServer, drive: Drive) -> None:
        self._base_from_cam = drive.calibration.base_from_body @ drive.rectifier.body_from_cam
        self._server, self._camera = server, drive.rectifier.camera
        self._image_ns, self._status = -(2**62), ("", "")

    def tell(self, state: LiveSurveyState) -> None:
        """Show the next state, with a log line if its status changed."""
        stamp_ns, estimate = state.stamp_ns, state.estimate

        def drawn(topic: str, draw: Callable[..., ChannelMessage], rows: Callable[[], Array]) -> Shown:
            return Shown(topic, stamp_ns, lambda: draw(stamp_ns, rows(), topic, SURVEY))

        shown = [
            drawn("/survey/landmarks", channels.points, lambda: _from_above(state.rows("landmarks_m"))),
            drawn("/survey/path", channels.path, lambda: _from_above(state.rows("path_m"))),
            drawn("/survey/revisits", channels.lines, lambda: state.rows("loops_m")),
        ]
        status = (state.phase, state.words) if estimate is None else (estimate.status, estimate.cause)
        if status != self._status:
            self._status = status
            shown.append(Shown("/log", stamp_ns, lambda: channels.status_log(stamp_ns, state.recording, *status)))
        if estimate is not None:
            shown += self._placed(estimate, state.recording)
        self._server.show(shown)

    def see(self, tracked: Tracked) -> None:
        """Receive a tracked frame: some are shown, with the points of the odometry."""
        frame, pixels = tracked.frame, tracked.pixels
        stamp_ns = frame.stamp_ns
        if stamp_ns - self._image_ns < _IMAGE_EVERY_NS:
            return
        self._image_ns = stamp_ns

        shown = [
            Shown("/camera", stamp_ns, lambda: channels.picture(stamp_ns, frame.left)),
            Shown("/camera/calibration", stamp_ns, lambda: channels.lens(stamp_ns, self._camera)),
        ]
        if pixels is not None:
            kept = np.array(pixels[:, :2], np.float64)
            shown.append(Shown("/camera/matches", stamp_ns, lambda: channels.matches(stamp_ns, kept)))
        self._server.show(shown)

    def _placed(self, estimate: EstimateMessage, name: str) -> list[Shown]:
        odom_from_base, stamp_ns = estimate.odom_from_base.target_from_source, estimate.stamp_ns
        joined, marks = [(ODOM, BASE, odom_from_base), (BASE, CAMERA, self._base_from_cam)], list[channels.RobotMark]()
        if estimate.map_from_odom is not None:
            map_from_odom = estimate.map_from_odom.target_from_source
            joined.append((SURVEY, ODOM, map_from_odom))
            marks.append(channels.RobotMark(name, map_from_odom @ odom_from_base, estimate.status))
        return [
            Shown("/survey/robot", stamp_ns, lambda: channels.robots(stamp_ns, marks, "/survey/robot", SURVEY)),
            Shown("/tf", stamp_ns, lambda: channels.links(stamp_ns, joined)),
        ]


def _from_above(rows: Array) -> Array:
    return np.column_stack([rows[:, :2], np.zeros(len(rows))])
