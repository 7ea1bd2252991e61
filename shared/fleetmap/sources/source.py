"""Sensor sources of a running robot. To add one: a file and a line in SOURCES, or a plug-in."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from fleetmap.errors import RecordingError, UsageError, chosen
from fleetmap.hooks import plugins
from fleetmap.recordings import FrameSelection, OpenOptions, Recording, Topics, open_recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import SensorSet
from fleetmap.sensors.source_settings import SourceSection
from fleetmap.sources.intake import Intake
from fleetmap.sources.replay_source import ReplaySource

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
