"""A live survey for Foxglove: the growing map, the robot's pose, and the tracked points of its camera."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.messages import EstimateMessage
from fleetmap.plugins.viewer_channels import channels
from fleetmap.plugins.viewer_channels.channels import BASE, CAMERA, ODOM, SURVEY, RobotMark, Shown
from mapserver.plugins.live_surveys.drives import Drive
from mapserver.plugins.live_surveys.message import LiveSurveyState
from mapserver.plugins.live_surveys.tracking import Tracked
from mapserver.plugins.live_surveys.viewer_server import FoxgloveServer

_IMAGE_EVERY_NS = 200_000_000


class LiveViewer:
    """Passes data to the server, which encodes it, so that no frame is delayed."""

    def __init__(self, server: FoxgloveServer, drive: Drive) -> None:
        base_from_cam = drive.calibration.base_from_body @ drive.rectifier.body_from_cam
        self._server, self._survey, self._camera = server, SurveyChannels(base_from_cam), drive.rectifier.camera
        self._image_ns = -(2**62)

    def tell(self, state: LiveSurveyState) -> None:
        self._server.show(self._survey.shown(state))

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


class SurveyChannels:
    """Running surveys, seen from above, in a separate frame `survey`."""

    def __init__(self, base_from_cam: Array | None = None) -> None:
        """base_from_cam (4, 4): mounting of the camera, if known."""
        self._base_from_cam = base_from_cam
        self._status = ("", "")

    def shown(self, state: LiveSurveyState) -> list[Shown]:
        """Messages of the next state, with a log line if its status changed."""
        stamp_ns, estimate = state.stamp_ns, state.estimate
        found = [
            Shown(
                "/survey/landmarks",
                stamp_ns,
                lambda: channels.points(stamp_ns, _from_above(state.landmarks()), "/survey/landmarks", SURVEY),
            ),
            Shown(
                "/survey/path",
                stamp_ns,
                lambda: channels.path(stamp_ns, _from_above(state.path()), "/survey/path", SURVEY),
            ),
            Shown(
                "/survey/revisits",
                stamp_ns,
                lambda: channels.lines(stamp_ns, state.loop_lines(), "/survey/revisits", SURVEY),
            ),
        ]
        status = (state.phase, state.words) if estimate is None else (estimate.status, estimate.cause)
        if status != self._status:
            self._status = status
            found.append(Shown("/log", stamp_ns, lambda: channels.status_log(stamp_ns, state.recording, *status)))
        if estimate is not None:
            found += self._placed(estimate, state.recording)
        return found

    def _placed(self, estimate: EstimateMessage, name: str) -> list[Shown]:
        odom_from_base, stamp_ns = estimate.odom_from_base.target_from_source, estimate.stamp_ns
        joined, marks = [(ODOM, BASE, odom_from_base)], list[RobotMark]()
        if self._base_from_cam is not None:
            joined.append((BASE, CAMERA, self._base_from_cam))
        if estimate.map_from_odom is not None:
            map_from_odom = estimate.map_from_odom.target_from_source
            joined.append((SURVEY, ODOM, map_from_odom))
            marks.append(RobotMark(name, map_from_odom @ odom_from_base, estimate.status))
        return [
            Shown("/survey/robot", stamp_ns, lambda: channels.robots(stamp_ns, marks, "/survey/robot", SURVEY)),
            Shown("/tf", stamp_ns, lambda: channels.links(stamp_ns, joined)),
        ]


def _from_above(rows: Array) -> Array:
    return np.column_stack([rows[:, :2], np.zeros(len(rows))])
