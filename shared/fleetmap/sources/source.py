"""Sensor sources of a running robot, and samples of a replay: a recording, forwards, or backwards with new stamps and without IMU.

To add a source: a file and a line in SOURCES, or a plug-in.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from fleetmap.errors import RecordingError, UsageError, chosen
from fleetmap.geometry import Indices
from fleetmap.hooks import plugins
from fleetmap.recordings import FrameSelection, OpenOptions, Recording, Topics, open_recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, SensorSet, wheel_between
from fleetmap.sensors.source_settings import SourceSection
from fleetmap.sources.intake import Intake
from fleetmap.sources.sensor_bundle import IMU_LEAD_NS, NEVER_NS, SensorBundle


@dataclass(frozen=True)
class ReplaySource:
    """Selected frames of a recording in the order of play.

    calibration has no IMU when played backwards: its samples would be wrong in that direction.
    """

    recording: Recording
    indices: Indices
    reverse: bool

    @classmethod
    def of(cls, recording: Recording, selection: FrameSelection, *, reverse: bool) -> "ReplaySource":
        """Create the source; raises UsageError if nothing is selected."""
        indices = selection.apply(recording)
        return cls(recording, indices[::-1] if reverse else indices, reverse)

    @property
    def calibration(self) -> RigCalibration:
        """Calibration of the rig as played."""
        return replace(self.recording.calibration, imu=None) if self.reverse else self.recording.calibration

    def __len__(self) -> int:
        return len(self.indices)

    def played_stamp_ns(self, recorded_ns: int) -> int:
        """Stamp at which a frame is played: mirrored at the last one when backwards."""
        if not self.reverse:
            return recorded_ns
        return 2 * int(self.recording.frame_stamps_ns[self.indices[0]]) - recorded_ns

    def recorded_stamp_ns(self, number: int) -> int:
        """Original stamp of frame `number` of the playback."""
        return int(self.recording.frame_stamps_ns[self.indices[number]])

    def frame(self, number: int) -> CameraFrame:
        """Frame `number` of the playback, decoded."""
        return self._played(self.recording.read_frame(int(self.indices[number])))

    def _played(self, frame: CameraFrame) -> CameraFrame:
        others = tuple(None if other is None else self._played(other) for other in frame.others)
        return replace(frame, stamp_ns=self.played_stamp_ns(frame.stamp_ns), others=others)

    def samples_before_each(self) -> Iterator[SensorBundle]:
        """For each frame of the playback, the other samples that are handled before it; none backwards."""
        recording, since_ns = self.recording, NEVER_NS
        # To the clock of the IMU and the wheels
        offset_ns = int(recording.calibration.cameras[0].imu_minus_cam_s * 1e9)
        for until_ns in recording.frame_stamps_ns[self.indices].tolist():
            if self.reverse:
                yield SensorBundle()
                continue
            imu = recording.imu.between(*(ns + offset_ns + IMU_LEAD_NS for ns in (since_ns, until_ns)))
            wheel = wheel_between(recording.wheel, *(ns + offset_ns + 1 for ns in (since_ns, until_ns)))
            priors = [prior for prior in recording.priors if since_ns < prior.stamp_ns <= until_ns]
            yield SensorBundle(None, imu, list(wheel), priors)
            since_ns = until_ns


_ROOM_WAIT_S = 0.1
_LONGEST_GAP_S = 10.0  # between frames: a longer one, such as days after a change of the clock, is skipped


class Source(Protocol):
    """Sensors. calibration: of the rig; has_depth: for a depth camera instead of a second one."""

    calibration: RigCalibration
    has_depth: bool

    def run(self, intake: Intake, wait: Callable[[float], bool]) -> None:
        """Put samples into the intake until they end or `wait`, which sleeps for the given seconds, returns that it must stop."""

    def close(self) -> None:
        """Close files and connections."""


class RecordingSource:
    """Plays a recording instead of sensors, once, at `speed` times its rate; 0 plays as fast as frames are consumed and drops none."""

    def __init__(self, recording: Recording, *, speed: float) -> None:
        self._recording, self._speed = recording, speed
        self._source = ReplaySource.of(recording, FrameSelection.parse(":"), reverse=False)
        self.calibration = recording.calibration
        self.has_depth = recording.sensor_set is SensorSet.RGBD

    def run(self, intake: Intake, wait: Callable[[float], bool]) -> None:
        begun_s, recorded_s = time.monotonic(), 0.0
        for number, before in enumerate(self._source.samples_before_each()):
            if number:
                gap_ns = self._source.recorded_stamp_ns(number) - self._source.recorded_stamp_ns(number - 1)
                recorded_s += min(gap_ns * 1e-9, _LONGEST_GAP_S)
            ahead_s = recorded_s / self._speed - (time.monotonic() - begun_s) if self._speed else 0.0
            if wait(max(0.0, ahead_s)):
                return
            while not self._speed and not intake.wait_for_room(_ROOM_WAIT_S):
                if wait(0.0):
                    return
            intake.put_imu(before.imu)
            for sample in before.wheel:
                intake.put_wheel(sample)
            for prior in before.priors:
                intake.put_prior(prior)
            try:
                intake.put_frame(self._recording.stored_frame(int(self._source.indices[number])))
            except RecordingError as error:
                intake.count_unreadable(str(error))

    def close(self) -> None:
        self._recording.close()


def _recording(section: SourceSection, topics: Topics, _map_frame: str) -> Source:
    if section.recording is None:
        raise UsageError('[source] recording is missing: kind = "recording" plays the recording at that path')
    calibration = None if section.calibration is None else Path(section.calibration)
    opened = open_recording(Path(section.recording), OpenOptions(calibration_file=calibration, topics=topics))
    return RecordingSource(opened, speed=section.speed)


SOURCES: dict[str, Callable[[SourceSection, Topics, str], Source]] = {"recording": _recording}


def open_source(section: SourceSection, topics: Topics, map_frame: str = "map") -> Source:
    """Open the source configured in the section; map_frame: the only accepted frame of position priors.

    UsageError for an unknown kind or a missing option, RecordingError and CalibrationError for unusable files.
    """
    openers = SOURCES if section.kind in SOURCES else SOURCES | plugins("locclient.sources")
    source: Source = chosen("[source] kind", section.kind, openers)(section, topics, map_frame)
    return source
