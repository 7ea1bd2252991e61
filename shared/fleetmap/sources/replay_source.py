"""Samples of a replay: a recording, forwards, or backwards with new stamps and without IMU."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.recordings import FrameSelection, Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, wheel_between
from fleetmap.sources.sensor_bundle import IMU_LEAD_NS, NEVER_NS, SensorBundle


@dataclass(frozen=True)
class ReplaySource:
    """Selected frames of a recording in the order of play.

    calibration has no IMU when played backwards: its samples would be wrong in that direction.
    """

    recording: Recording
    indices: NDArray[np.int64]
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
