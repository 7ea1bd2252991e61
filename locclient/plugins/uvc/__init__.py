"""A UVC stereo camera that delivers both images side by side, through OpenCV; IMU and wheels come as ROS 2 topics."""

import threading
import time
from collections.abc import Callable

import cv2
import numpy as np

from fleetmap.errors import RecordingError, UsageError
from fleetmap.recordings import Topics
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame
from fleetmap.sensors.source_settings import SourceSection
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import Source
from locclient.plugins.ros2_node import rig_of, topics_beside

_REOPEN_S, _JOINED_S = 1.0, 5.0
_CLOCKS_AGREE_S = 1.0


class UvcSource:
    """Frames of a side-by-side camera, stamped on the clock of the topics.

    A frame's stamp is the driver's if it uses the monotonic clock, as Linux's does, else the arrival time; in
    both cases minus delay_s, measured once for a camera (half its exposure and, for the arrival time, its transfer). A camera that
    is unplugged is reopened once it is back.
    """

    def __init__(
        self,
        open_capture: Callable[[], cv2.VideoCapture],
        calibration: RigCalibration,
        section: SourceSection,
        topics: Source | None,
        *,
        monotonic_s: Callable[[], float] = time.monotonic,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """section: requested size of both images together, width_px x height_px. topics: of the other sensors, None for none."""
        self._open, self._section, self._topics = open_capture, section, topics
        self._monotonic_s, self._wall_ns = monotonic_s, wall_ns
        self.calibration, self.has_depth = calibration, False
        self._others: threading.Thread | None = None

    def run(self, intake: Intake, wait: Callable[[float], bool]) -> None:
        if self._topics is not None:
            self._others = threading.Thread(target=self._topics.run, args=(intake, wait), name="topics", daemon=True)
            self._others.start()
        while not wait(0.0):
            capture = self._open()
            try:
                self._read_frames(capture, intake, wait)
            finally:
                capture.release()
            if wait(_REOPEN_S):
                return

    def close(self) -> None:
        if self._others is not None:
            self._others.join(_JOINED_S)
        if self._topics is not None:
            self._topics.close()

    def _read_frames(self, capture: cv2.VideoCapture, intake: Intake, wait: Callable[[float], bool]) -> None:
        """Read frames until the camera is gone or a stop is requested."""
        if not capture.isOpened():
            return
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._section.width_px)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._section.height_px)
        capture.set(cv2.CAP_PROP_FPS, self._section.rate_hz)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # with several, the oldest would come first
        while not wait(0.0):
            is_open, picture = capture.read()
            if not is_open:
                return
            try:
                intake.put_frame(split_frame(np.asarray(picture), self._stamp_ns(capture)))
            except RecordingError as error:
                intake.count_unreadable(str(error))

    def _stamp_ns(self, capture: cv2.VideoCapture) -> int:
        now_s, wall_ns = self._monotonic_s(), self._wall_ns()
        driver_s = capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3
        age_s = now_s - driver_s if abs(now_s - driver_s) < _CLOCKS_AGREE_S else 0.0
        return wall_ns - round((max(age_s, 0.0) + self._section.delay_s) * 1e9)


def open_source(section: SourceSection, topics: Topics, map_frame: str) -> UvcSource:
    """Open `[source] kind = "uvc"`; see `fleetmap.sources.source.open_source`."""
    if section.sensors != "stereo":
        raise UsageError(
            f'[source] sensors = "{section.sensors}": a uvc camera sends pairs; take topics, kind = "ros2"'
        )
    device: int | str = int(section.device) if section.device.isdecimal() else section.device
    others = topics_beside(section, topics, map_frame)
    return UvcSource(lambda: cv2.VideoCapture(device), rig_of(section), section, others)


def split_frame(picture: np.ndarray, stamp_ns: int) -> CameraFrame:
    """Split an image (H, 2 W) or (H, 2 W, 3) into its left and right half, grey; RecordingError for anything else."""
    if picture.dtype != np.uint8 or picture.ndim not in (2, 3) or picture.shape[1] % 2 or not picture.size:
        reason = f"the camera sent {picture.dtype} of shape {picture.shape}; two pictures side by side are expected"
        raise RecordingError(reason)
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
    middle = grey.shape[1] // 2
    return CameraFrame(stamp_ns, np.ascontiguousarray(grey[:, :middle]), np.ascontiguousarray(grey[:, middle:]))
