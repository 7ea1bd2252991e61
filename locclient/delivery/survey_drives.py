"""Drives through areas of which operators want a new survey: kept on the disk as recordings, and handed to the server in parts.

A drive begins and ends some metres outside of its area, where the map is known: what stands anew in it joins no map alone. A robot that
loses its place inside goes on recording, a lifted one drops the drive. Frames are as the cameras gave them, at most ten a second.
"""

import logging
import uuid
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np

from fleetmap.errors import FleetmapError, LinkError, disk_errors
from fleetmap.failure_summary import MAX_DRIVE_BYTES, ReplayPart
from fleetmap.geometry import Array, inside_rings
from fleetmap.mapformat.building import edge_distance_m
from fleetmap.messages import PART_BYTES, Cause, Status, SurveyArea, encode_message
from fleetmap.recordings.images import StoredFrame, StoredImage, decode_grey, jpeg_image, store_frame
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.localization.estimate import Estimate
from locclient.maps.map_client import MapClient

_MARGIN_M = 6.0  # around an area
_BEGIN_M = 0.5  # a robot that stands records nothing
_LONGEST_NS = 120_000_000_000
_STEP_NS = 95_000_000
_QUALITY = 90  # of JPEG
_DRIVES, _WAITING = 2, 4  # of a request; files on the disk
_MOST_QUEUED = 100  # frames: beyond, the disk is too slow
_log = logging.getLogger(__name__)


class SurveyDrives:
    """Recordings of one robot. `handle` is for the localizing thread, `work` for that of the disk, `deliver_part` for the network's."""

    def __init__(self, folder: Path, calibration: RigCalibration) -> None:
        """folder: of the drives that wait to be sent; what a killed robot left there unfinished is removed."""
        self.requests: tuple[SurveyArea, ...] = ()
        self._folder, self._calibration = folder, calibration
        self._queue: deque[SensorBundle | str | bool] = deque()  # a request's id begins a drive; the end: is it kept?
        self._area: SurveyArea | None = None
        self._from_m: Array | None = None  # the last known place before a drive, then that of its beginning
        self._begun_ns = self._framed_ns = 0
        self._is_useful, self._is_full = False, False
        self._driven: dict[str, int] = {}
        self._writer: McapRecordingWriter | None = None
        self._path, self._bytes = folder, 0
        self._sent_bytes: dict[str, int] = {}
        for path in folder.glob("*.part"):
            path.unlink(missing_ok=True)

    def handle(self, bundle: SensorBundle, estimate: Estimate | None) -> None:
        """Take a bundle that the robot has localized; estimate: None without a frame."""
        if estimate is not None:
            if estimate.cause is Cause.CARRIED:  # of a lifted robot nothing is known in between
                self._is_useful = False
                self._end()
            map_from_body = estimate.map_from_body if estimate.status is Status.TRACKING else None
            self._follow(None if map_from_body is None else map_from_body[:2, 3], estimate.stamp_ns)
        if self._area is None:
            return
        frame = bundle.frame
        if frame is not None and frame.stamp_ns - self._framed_ns < _STEP_NS:
            frame = None
        elif frame is not None:
            self._framed_ns = frame.stamp_ns
        self._queue.append(replace(bundle, frame=frame))

    def work(self) -> None:
        """Write what was recorded. A drive that the disk refuses is lost."""
        while self._queue:
            try:
                with disk_errors(f"{self._folder} cannot be written", "free some space"):
                    self._write(self._queue.popleft())
            except FleetmapError as error:
                _log.warning("a drive for a survey is lost: %s", error)
                self._close(is_kept=False)

    def finish(self) -> None:
        """End a drive at the end of the program."""
        self._end()
        self.work()

    def deliver_part(self, client: MapClient) -> bool:
        """Send a part of the oldest drive; False if none waits or the server accepts none now. StoreError if the disk refuses."""
        with disk_errors(f"{self._folder} cannot be read", "check the disk"):
            path = min(self._folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns, default=None)
            if path is None:
                return False
            offset, size = self._sent_bytes.get(path.stem, 0), path.stat().st_size
            with path.open("rb") as file:
                file.seek(offset)
                data = file.read(PART_BYTES)
            request, _, name = path.stem.partition("-")
            part = ReplayPart(id=name, total_bytes=size, offset=offset, data=data, survey=request)
            try:
                ack = client.deliver("replays", encode_message(part))
            except LinkError as error:
                _log.info("a drive for survey %s waits: %s", request, error)
                return False
            if ack.refused or ack.received_bytes >= size:
                _log.info("the drive for survey %s is %s", request, ack.refused or "delivered")
                self._sent_bytes.pop(path.stem, None)
                path.unlink()
            else:
                self._sent_bytes[path.stem] = ack.received_bytes
            return ack.received_bytes > offset

    def _follow(self, place: Array | None, now_ns: int) -> None:
        """Begin or end a drive at a place (2,) in `map`, None if unknown."""
        area = self._area
        if area is None:
            if place is None:
                return
            self._from_m = place if self._from_m is None else self._from_m
            if np.linalg.norm(place - self._from_m) < _BEGIN_M:
                return
            self._from_m = place
            due = (a for a in self.requests if self._driven.get(a.id, 0) < _DRIVES and _off_m(a, place) < _MARGIN_M)
            self._area = next(due, None)
            if self._area is not None:
                self._begun_ns, self._framed_ns, self._is_useful, self._is_full = now_ns, 0, False, False
                self._queue.append(self._area.id)
            return
        if place is not None:
            self._is_useful |= _off_m(area, place) == 0.0
        is_past = place is not None and _off_m(area, place) >= _MARGIN_M
        too_much = self._is_full or len(self._queue) > _MOST_QUEUED or now_ns - self._begun_ns > _LONGEST_NS
        if is_past or too_much or area not in self.requests:
            self._end()
            self._from_m = place

    def _end(self) -> None:
        if self._area is not None:
            if self._is_useful:
                self._driven[self._area.id] = self._driven.get(self._area.id, 0) + 1
            self._queue.append(self._is_useful)
            self._area = None

    def _write(self, taken: SensorBundle | str | bool) -> None:
        if isinstance(taken, str):
            self._folder.mkdir(parents=True, exist_ok=True)
            if len(list(self._folder.glob("*.mcap"))) < _WAITING:
                self._path, self._bytes = self._folder / f"{taken}-{uuid.uuid4().hex[:12]}.mcap", 0
                self._writer = McapRecordingWriter(self._path, self._calibration)
        elif isinstance(taken, bool):
            self._close(is_kept=taken)
        elif self._writer is not None:
            if self._calibration.imu is not None:
                self._writer.write_imu(taken.imu)
            self._writer.write_wheel(taken.wheel)
            if taken.frame is not None and not self._is_full:
                frame = _stored(taken.frame)
                parts = [frame, *(other for other in frame.others if other is not None)]
                self._bytes += sum(len(each.data) for v in parts for each in (v.left, v.right, v.depth) if each)
                self._writer.write_frame(frame)
                self._is_full = self._bytes > 0.9 * MAX_DRIVE_BYTES  # the rest: samples, and the frames until it ends

    def _close(self, *, is_kept: bool) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close() if is_kept else writer.discard()
            if is_kept and self._path.stat().st_size > MAX_DRIVE_BYTES:
                self._path.unlink()


def _off_m(area: SurveyArea, place: Array) -> float:
    """Return the distance of a place (2,) from an area, 0 inside."""
    ring = np.array(area.corners_map_m)
    return 0.0 if inside_rings(place[None], [ring])[0] else edge_distance_m(place, [ring])


def _stored(frame: CameraFrame | StoredFrame) -> StoredFrame:
    """Return a frame with its grey images as files, compressed if they are not."""
    stored = frame if isinstance(frame, StoredFrame) else store_frame(frame)
    others = tuple(None if other is None else _stored(other) for other in stored.others)
    right = None if stored.right is None else _file(stored.right)
    return replace(stored, left=_file(stored.left), right=right, others=others)


def _file(image: StoredImage) -> StoredImage:
    return image if image.encoding == "file" else jpeg_image(decode_grey(image), _QUALITY)
