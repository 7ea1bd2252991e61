"""A recording driven again and again: left and entered where place, heading and velocity agree, stamps going on."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.recordings import Recording
from fleetmap.recordings.images import StoredFrame, decode_frame
from fleetmap.recordings.recording import WrappedFrames
from fleetmap.sensors.samples import CameraFrame, ImuSamples, Trajectory


@dataclass(frozen=True)
class _Laps(WrappedFrames):
    """The frames of a recording, the last ones again and again: index (F,) of each, and by how much its stamp is later (F,)."""

    index: NDArray[np.int64]
    later_ns: NDArray[np.int64]

    def stored(self, index: int) -> StoredFrame:
        frame = self.source.stored(int(self.index[index]))
        return replace(frame, stamp_ns=frame.stamp_ns + int(self.later_ns[index]))

    def frame(self, index: int) -> CameraFrame:
        return decode_frame(self.stored(index))

    def part(self, indices: NDArray[np.int64]) -> "_Laps":
        return _Laps(self.source.part(self.index[indices]), np.arange(len(indices)), self.later_ns[indices])


def repeated(recording: Recording, laps: int) -> Recording:
    """The recording up to where it is best left for an earlier place, and from there on again, `laps` times in all."""
    stamps_ns, truth = recording.frame_stamps_ns, recording.ground_truth
    first, last = _seam(truth, stamps_ns)
    start_ns, lap_ns = int(stamps_ns[first]), int(stamps_ns[last] - stamps_ns[first])
    lap = np.arange(first, last)
    index = np.concatenate([np.arange(first), *([lap] * laps)])
    later_ns = np.repeat(np.arange(laps), [last, *([last - first] * (laps - 1))]) * lap_ns

    def again(stamps: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of other samples, and their stamps."""
        begun = np.flatnonzero(stamps < start_ns)
        inside = np.flatnonzero((stamps >= start_ns) & (stamps < start_ns + lap_ns))
        shifted = [stamps[inside] + number * lap_ns for number in range(laps)]
        return np.concatenate([begun, *([inside] * laps)]), np.concatenate([stamps[begun], *shifted])

    imu_rows, imu_ns = again(recording.imu.stamps_ns)
    truth_rows, truth_ns = again(truth.stamps_ns)
    wheel_rows, wheel_ns = again(np.array([sample.stamp_ns for sample in recording.wheel], np.int64))
    return replace(
        recording,
        frames=_Laps(recording.frames, index, later_ns),
        frame_stamps_ns=stamps_ns[index] + later_ns,
        imu=ImuSamples(imu_ns, recording.imu.gyro_radps[imu_rows], recording.imu.accel_mps2[imu_rows]),
        wheel=tuple(
            replace(recording.wheel[row], stamp_ns=stamp_ns)
            for row, stamp_ns in zip(wheel_rows.tolist(), wheel_ns.tolist(), strict=True)
        ),
        ground_truth=Trajectory(truth_ns, truth.frame_from_body[truth_rows]),
    )


def _seam(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> tuple[int, int]:
    """An early and a late frame between which the drive can jump: alike in place, heading and velocity."""
    nearest = np.clip(np.searchsorted(truth.stamps_ns, stamps_ns), 0, len(truth) - 1)
    places = truth.frame_from_body[nearest]
    seconds = (truth.stamps_ns[nearest] - truth.stamps_ns[nearest[0]]) * 1e-9
    state = np.hstack([places[:, :3, 3], np.gradient(places[:, :3, 3], seconds, axis=0), 3.0 * places[:, :3, 0]])
    half = len(stamps_ns) // 2
    apart = np.linalg.norm(state[:half, None] - state[None, half:], axis=2)
    first, last = np.unravel_index(np.argmin(apart), apart.shape)
    return int(first), half + int(last)
