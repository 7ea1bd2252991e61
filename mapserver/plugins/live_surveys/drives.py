"""Sources of a live survey: a recording that is played, or a robot's sensors, which are recorded at the same time."""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Generator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fleetmap.errors import FleetmapError, RecordingError, UsageError
from fleetmap.geometry import Indices
from fleetmap.recordings import Recording, StoredFrame, Topics
from fleetmap.recordings.images import decode_frame
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.recordings.recording import sensors_of_view
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import ImuSamples, SensorSet, WheelSample
from fleetmap.sources.intake import Intake
from fleetmap.sources.sensor_bundle import SensorBundle
from fleetmap.sources.source import Source
from mapserver.config import survey_settings
from mapserver.drafting.admission import refuse_hopeless
from mapserver.drafting.draft import BuildOptions, BuildRequest
from mapserver.drafting.worker import read_ahead
from mapserver.survey.odometry_pass import SampleFeed

_BEGIN_S = 0.2  # delay of the first frame
_AHEAD = 8  # limit of decoded frames in the queue
_QUEUE = 40  # frames of sensors that may wait for tracking: two seconds
_IMU_WAIT_S = 0.05
_POLL_S = 0.25
_SILENCE_S = 10.0  # limit for the first message of a sensor


class DueFrame(NamedTuple):
    """A frame with the IMU and wheel samples before it, and its arrival on the monotonic clock; None if not played in real time."""

    frame: RectifiedFrame
    imu: ImuSamples
    wheel: list[WheelSample]
    due_s: float | None


class Drive(ABC):
    """A survey's frames in time, at `speed` times the rate of their stamps. request: for a draft of all of them; settings: of its survey;
    dropped: frames that arrived too fast."""

    def __init__(
        self, request: BuildRequest, name: str, calibration: RigCalibration, sensors: SensorSet, speed: float
    ) -> None:
        self.name, self.calibration, self.speed, self.dropped = name, calibration, speed, 0
        self.settings = survey_settings(request.options.config, sensors)
        self.request = replace(request, options=replace(request.options, settings=self.settings))
        self.rectifier = Rectifier(calibration, has_depth=sensors is SensorSet.RGBD)

    def check(self) -> list[str]:
        """Return shortcomings as text; RecordingError for what a build would refuse, as far as known before the drive."""
        return []

    @abstractmethod
    def frames(self) -> Generator[DueFrame | None, None, None]:
        """Yield each frame when it is due; None from time to time while waiting."""

    @abstractmethod
    def finish(self, count: int) -> BuildOptions:
        """Return the options of a build of the `count` used frames."""


class RecordedDrive(Drive):
    """A recording, played at `speed` times its own rate; 0 for as fast as its frames are processed."""

    def __init__(self, request: BuildRequest, recording: Recording, indices: Indices, speed: float) -> None:
        """recording, indices: what the request names, opened."""
        if not (np.isfinite(speed) and speed >= 0):
            raise UsageError(f"--speed {speed}: give 1 for the recording's own speed, 0 for as fast as it goes")
        self._recording, self._indices = recording.view(0), indices
        super().__init__(request, recording.name, self._recording.calibration, recording.sensor_set, speed)

    def check(self) -> list[str]:
        refuse_hopeless(self._recording)
        return [f"issue: {issue.what}: {issue.detail}" for issue in self._recording.issues]

    def frames(self) -> Generator[DueFrame | None, None, None]:
        """See Drive."""
        recording, begin_s = self._recording, time.monotonic() + _BEGIN_S
        feed = SampleFeed(recording.imu, recording.wheel, self.rectifier.imu_minus_cam_s)
        first_ns = int(recording.frame_stamps_ns[self._indices[0]])
        rectified = (self.rectifier.rectify(recording.read_frame(int(index))) for index in self._indices)
        for frame in read_ahead(rectified, _AHEAD):
            due_s = None
            if self.speed:
                due_s = begin_s + (frame.stamp_ns - first_ns) * 1e-9 / self.speed
                time.sleep(max(0.0, due_s - time.monotonic()))
            imu, wheel = feed.until(frame.stamp_ns)
            yield DueFrame(frame, imu, list(wheel), due_s)

    def finish(self, count: int) -> BuildOptions:
        if count == len(self._indices):
            return self.request.options
        seen = self._indices[: max(count, 1)]
        step = int(self._indices[1] - self._indices[0]) if len(self._indices) > 1 else 1
        return replace(self.request.options, frames=f"{int(seen[0])}:{int(seen[-1]) + 1}:{step}")


class SensorDrive(Drive):
    """The sensors of a robot, judged by their data. Every sample is recorded; after a crash the file lacks at most the last second."""

    def __init__(self, request: BuildRequest, source: Source, topics: Topics) -> None:
        """request: of the MCAP file to write; UsageError if it exists."""
        (path,), rig = request.recordings, source.calibration
        if path.suffix != ".mcap" or path.exists():
            raise UsageError(f"--record {path}: name a new file that ends in .mcap")
        sensors = sensors_of_view(len(rig.cameras) > 1, source.has_depth, rig.imu is not None)
        super().__init__(request, path.stem, rig, sensors, 1.0)
        self._source, self._path, self._topics = source, path, topics
        self._ended, self._recorded_frames = threading.Event(), 0
        self._fault: Exception | None = None
        self._intake = Intake(
            frames=_QUEUE,
            imu_minus_cam_s=self.rectifier.imu_minus_cam_s,
            has_imu=rig.imu is not None,
            imu_wait_s=_IMU_WAIT_S,
        )

    def frames(self) -> Generator[DueFrame | None, None, None]:
        """See Drive; RecordingError if the sensors fail, naming the recording up to there."""
        feeding = threading.Thread(target=self._feed, name="sensors", daemon=True)
        writer = McapRecordingWriter(self._path, self.calibration, topics=self._topics, in_place=True)
        feeding.start()
        begun_s = time.monotonic()
        try:
            while not self._intake.exhausted:
                bundle = self._take()
                due_s = time.monotonic()
                self.dropped = self._intake.counts.frames_dropped
                frame = None if bundle.frame is None else self._recorded(writer, bundle)
                yield None if frame is None else DueFrame(frame, bundle.imu, bundle.wheel, due_s)
                if due_s - begun_s > _SILENCE_S:
                    self._refuse_silence()
            if self._fault is not None:
                raise self._ended_by(self._fault)
        finally:
            self._ended.set()
            feeding.join(5.0)
            self._source.close()
            if self._recorded_frames:
                writer.close()
            else:
                writer.discard()

    def finish(self, count: int) -> BuildOptions:
        if not count:
            self._refuse_silence()
            raise RecordingError(
                f"no frame could be used; check the sensors with `locclient check`{self._unreadable()}"
            )
        return replace(self.request.options, frames="::", calibration=None, topics=self._topics, use=None)

    def _refuse_silence(self) -> None:
        """Raise RecordingError if cameras or IMU have sent nothing, with their expected topics."""
        counts, topics = self._intake.counts, self._topics
        second = topics.depth if self._source.has_depth else topics.right if len(self.calibration.cameras) > 1 else ""
        if not counts.frames:
            images = f"{topics.left} and {second}" if second else topics.left
            raise RecordingError(
                f"no frame came from the sensors: images are expected on {images}; check [source] sensors and [topics] with "
                f"`locclient check`{self._unreadable()}"
            )
        if self.calibration.imu is not None and not counts.imu_samples:
            raise RecordingError(
                f"{self._path}: images arrive, but no sample of the calibration's IMU; it is expected on {topics.imu}. Start "
                "it, correct [topics] imu, or take it out of the calibration file"
            )

    def _unreadable(self) -> str:
        count = self._intake.counts.unreadable
        unread = f"; {count} messages could not be read ({self._intake.unreadable_why})" if count else ""
        return unread + "".join(f"; {fault}" for fault in self._intake.source_faults)

    def _feed(self) -> None:
        try:
            self._source.run(self._intake, self._ended.wait)
        except Exception as error:  # after any error the drive must not look complete
            self._fault = error
        finally:
            self._intake.finish()

    def _take(self) -> SensorBundle:
        try:
            bundle = self._intake.take(_POLL_S)
        except RecordingError as error:
            raise self._ended_by(error) from error
        if bundle.left_out:  # of which a survey is not made
            raise self._ended_by(RecordingError("; ".join(bundle.left_out.values())))
        return bundle

    def _ended_by(self, fault: Exception) -> RecordingError:
        reason = str(fault) if isinstance(fault, FleetmapError) else f"{type(fault).__name__}: {fault}"
        kept = "nothing was recorded before"
        if self._recorded_frames:
            kept = f"{self._path} holds the drive up to there, and `mapserver build {self._path}` makes a map of it"
        return RecordingError(f"the sensors ended the drive: {reason}; {kept}")

    def _recorded(self, writer: McapRecordingWriter, bundle: SensorBundle) -> RectifiedFrame | None:
        """Return the frame for tracking; None, without recording it, if it is unreadable."""
        writer.write_imu(bundle.imu)
        writer.write_wheel(bundle.wheel)
        writer.write_prior(bundle.priors)
        assert bundle.frame is not None
        try:
            frame = decode_frame(bundle.frame) if isinstance(bundle.frame, StoredFrame) else bundle.frame
            rectified = self.rectifier.rectify(frame)
        except FleetmapError as error:
            self._intake.count_unreadable(str(error))
            return None
        writer.write_frame(bundle.frame)
        self._recorded_frames += 1
        return rectified
