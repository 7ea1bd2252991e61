"""A live survey for Foxglove: the growing map, the robot's pose, and the tracked points of its camera."""

import numpy as np

from fleetmap.foxglove import channels
from fleetmap.foxglove.channels import Shown, SurveyChannels
from fleetmap.foxglove.server import FoxgloveServer
from fleetmap.live_survey import LiveSurveyState
from mapserver.live.drives import Drive
from mapserver.survey.live.tracking import Tracked

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
