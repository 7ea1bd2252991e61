"""Playback of a recording instead of the robot's sensors."""

import time
from collections.abc import Callable

from fleetmap.errors import RecordingError
from fleetmap.recordings import FrameSelection, Recording
from fleetmap.sensors.samples import SensorSet
from fleetmap.sources.intake import Intake
from fleetmap.sources.replay_source import ReplaySource

_ROOM_WAIT_S = 0.1
_LONGEST_GAP_S = 10.0  # between frames: a longer one, such as days after a change of the clock, is skipped


class RecordingSource:
    """Plays all frames once, at `speed` times the recorded rate; 0 plays as fast as they are consumed and drops none."""

    def __init__(self, recording: Recording, *, speed: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._recording, self._speed, self._clock_s = recording, speed, clock_s
        self._source = ReplaySource.of(recording, FrameSelection.parse(":"), reverse=False)
        self.calibration = recording.calibration
        self.has_depth = recording.sensor_set is SensorSet.RGBD

    def run(self, intake: Intake, wait: Callable[[float], bool]) -> None:
        begun_s, recorded_s = self._clock_s(), 0.0
        for number, imu in enumerate(self._source.imu_before_each()):
            if number:
                gap_ns = self._source.recorded_stamp_ns(number) - self._source.recorded_stamp_ns(number - 1)
                recorded_s += min(gap_ns * 1e-9, _LONGEST_GAP_S)
            if wait(self._ahead_s(recorded_s, begun_s)):
                return
            while not self._speed and not intake.wait_for_room(_ROOM_WAIT_S):
                if wait(0.0):
                    return
            intake.put_imu(imu)
            for sample in self._source.wheel_before(number):
                intake.put_wheel(sample)
            for prior in self._source.priors_before(number):
                intake.put_prior(prior)
            try:
                intake.put_frame(self._recording.stored_frame(int(self._source.indices[number])))
            except RecordingError as error:
                intake.count_unreadable(str(error))

    def close(self) -> None:
        self._recording.close()

    def _ahead_s(self, recorded_s: float, begun_s: float) -> float:
        return max(0.0, recorded_s / self._speed - (self._clock_s() - begun_s)) if self._speed else 0.0
