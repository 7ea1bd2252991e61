"""Recordings with one thing wrong, made from good ones; `copy_to_mcap` writes them as files."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.recordings import Recording
from fleetmap.recordings.images import StoredFrame, decode_frame, decode_grey, png_image
from fleetmap.recordings.recording import WrappedFrames
from fleetmap.sensors.samples import CameraFrame, ImuSamples, SensorSet


@dataclass(frozen=True)
class _Frames(WrappedFrames):
    """Some frames of another source, each spoiled."""

    indices: NDArray[np.int64]
    spoil: Callable[[StoredFrame], StoredFrame]

    def stored(self, index: int) -> StoredFrame:
        return self.spoil(self.source.stored(int(self.indices[index])))

    def frame(self, index: int) -> CameraFrame:
        return decode_frame(self.stored(index))

    def part(self, indices: NDArray[np.int64]) -> "_Frames":
        return _Frames(self.source.part(self.indices[indices]), np.arange(len(indices)), self.spoil)


@dataclass(frozen=True)
class _ChangedFrames(WrappedFrames):
    change: Callable[[CameraFrame], CameraFrame]

    def frame(self, index: int) -> CameraFrame:
        return self.change(self.source.frame(index))

    def part(self, indices: NDArray[np.int64]) -> "_ChangedFrames":
        return _ChangedFrames(self.source.part(indices), self.change)


def changed(recording: Recording, change: Callable[[CameraFrame], CameraFrame]) -> Recording:
    """The recording with each of its frames changed on the way."""
    return replace(recording, frames=_ChangedFrames(recording.frames, change))


def with_frames(
    recording: Recording, indices: NDArray[np.int64], spoil: Callable[[StoredFrame], StoredFrame] = lambda frame: frame
) -> Recording:
    """The frames at `indices` alone, each changed by `spoil`."""
    frames = _Frames(recording.frames, indices, spoil)
    return replace(recording, frames=frames, frame_stamps_ns=recording.frame_stamps_ns[indices])


def part(recording: Recording, start_s: float, end_s: float) -> Recording:
    """The frames from start_s to end_s after the first; everything else whole."""
    times_s = (recording.frame_stamps_ns - recording.frame_stamps_ns[0]) * 1e-9
    return with_frames(recording, np.flatnonzero((times_s >= start_s) & (times_s < end_s)))


def with_lost_frames(recording: Recording, share: float, rng: np.random.Generator) -> Recording:
    """Without so many of the frames, drawn at random."""
    kept = np.sort(rng.permutation(len(recording))[: round((1 - share) * len(recording))])
    return with_frames(recording, kept)


def with_darkness(recording: Recording, start_s: float, end_s: float) -> Recording:
    """Both cameras see nothing but a little noise from start_s to end_s after the first frame."""
    first_ns = int(recording.frame_stamps_ns[0])

    def darken(frame: StoredFrame) -> StoredFrame:
        if not start_s <= (frame.stamp_ns - first_ns) * 1e-9 < end_s:
            return frame
        rng = np.random.default_rng(frame.stamp_ns)
        shape = decode_grey(frame.left).shape
        left, right = (png_image(np.clip(rng.normal(2.0, 0.8, shape), 0, 255).astype(np.uint8)) for _ in range(2))
        return StoredFrame(frame.stamp_ns, left, right)

    return with_frames(recording, np.arange(len(recording)), darken)


def with_imu(recording: Recording, imu: ImuSamples) -> Recording:
    """With another run's IMU, moved to begin when its own begins."""
    moved_ns = int(recording.imu.stamps_ns[0]) - int(imu.stamps_ns[0])
    return replace(recording, imu=replace(imu, stamps_ns=imu.stamps_ns + moved_ns))


def imu(accel: Array | float = 1.0, gyro: Array | float = 1.0) -> Callable[[Recording], Recording]:
    """Samples multiplied by matrices (3, 3) or numbers."""
    by_accel, by_gyro = (np.eye(3) * by if np.ndim(by) < 2 else by for by in (accel, gyro))
    multiplied = lambda of: ImuSamples(of.stamps_ns, of.gyro_radps @ by_gyro.T, of.accel_mps2 @ by_accel.T)  # noqa: E731
    return lambda recording: replace(recording, imu=multiplied(recording.imu))


def without_imu(recording: Recording) -> Recording:
    """Cameras alone."""
    calibration = replace(recording.calibration, imu=None)
    return replace(recording, imu=ImuSamples.empty(), calibration=calibration, sensor_set=SensorSet.STEREO)


def with_clock_shift(recording: Recording, shift_s: float) -> Recording:
    """The IMU's stamps are later by shift_s, which the calibration does not say."""
    stamps_ns = recording.imu.stamps_ns + round(shift_s * 1e9)
    return replace(recording, imu=replace(recording.imu, stamps_ns=stamps_ns))
