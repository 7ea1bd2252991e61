"""Samples of a replay: a recording, forwards, or backwards with new stamps and without IMU."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.recordings import FrameSelection, Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, ImuSamples, PositionPrior, WheelSample, wheel_between

_IMU_LEAD_NS = 10_000_000  # a frame is handled once IMU samples slightly past it have arrived
_NEVER_NS = -(2**62)


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

    def imu_before_each(self) -> Iterator[ImuSamples]:
        """For each frame of the playback, the IMU samples that arrive before it is handled; none backwards."""
        for number in range(len(self)):
            since_ns, until_ns = (self._body_ns(each) + _IMU_LEAD_NS for each in (number - 1, number))
            yield ImuSamples.empty() if self.reverse else self.recording.imu.between(since_ns, until_ns)

    def priors_before(self, number: int) -> list[PositionPrior]:
        """Coarse poses in the recording between the frame before and frame `number`; none backwards."""
        if self.reverse:
            return []
        since = self.recorded_stamp_ns(number - 1) if number else _NEVER_NS
        return [p for p in self.recording.priors if since < p.stamp_ns <= self.recorded_stamp_ns(number)]

    def wheel_before(self, number: int) -> Sequence[WheelSample]:
        """Wheel odometry between the frame before and frame `number`; none backwards."""
        if self.reverse:
            return []
        return wheel_between(self.recording.wheel, self._body_ns(number - 1) + 1, self._body_ns(number) + 1)

    def _body_ns(self, number: int) -> int:
        """Stamp of a frame on the clock of the IMU and the wheels; -1 for before all frames."""
        offset_ns = int(self.recording.calibration.cameras[0].imu_minus_cam_s * 1e9)
        return _NEVER_NS if number < 0 else self.recorded_stamp_ns(number) + offset_ns

    def truth_map_from_body(self, number: int) -> Array | None:
        """The recording's ground truth at frame `number`, None if absent."""
        truth = self.recording.ground_truth
        return None if truth is None else truth.at(self.recorded_stamp_ns(number))
