"""IMU and wheel samples that came and may still be needed."""

from collections.abc import Sequence

import numpy as np

from fleetmap.geometry import Array
from fleetmap.inertial import preintegrate
from fleetmap.odometry import sensor_kernels
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import INTEGRATED_NS, PAUSE_NS, ImuSamples, Stamps, WheelSample

IMU_GAP_NS = 35_000_000  # a longer time without samples is bridged as without an IMU; one of 30 Hz has none
_WHEEL_REACH_NS = 30_000_000  # a sample serves a frame within half the period of slow wheel odometry
_LEAST_ROOM = 1024  # samples


def is_pause(imu_stamps_ns: Stamps, start_ns: int, end_ns: int) -> bool:
    """True if no motion is carried from one moment to another, both on the IMU's clock: samples that are all there carry it longer."""
    is_missing = sensor_kernels.longest_gap_ns(imu_stamps_ns, start_ns, end_ns) > IMU_GAP_NS
    return end_ns - start_ns > (PAUSE_NS if is_missing else INTEGRATED_NS)


class SensorBuffer:
    """Samples in order of their stamps, on the IMU's clock; spikes of the IMU are left out.

    `imu` is a view of rows that are never written again: where there is no room behind them, they move to other arrays.
    """

    def __init__(self) -> None:
        self.imu = ImuSamples.empty()
        self._room, self._first, self._end = ImuSamples.empty(), 0, 0
        self._pending: list[ImuSamples] = []
        self._wheel: list[WheelSample] = []

    def add_imu(self, samples: ImuSamples) -> None:
        """Takes samples newer than any before; `imu` shows them after `absorb`."""
        self._pending.append(samples)

    def add_wheel(self, samples: Sequence[WheelSample]) -> None:
        """Takes samples newer than any before."""
        self._wheel.extend(samples)

    def absorb(self, needed_from_ns: int, memory_s: float) -> None:
        """Appends what came; drops IMU samples older than memory_s before needed_from_ns once they are many, and wheel samples as old.

        Without an IMU wheels serve no start: all go that serve no frame from needed_from_ns on.
        """
        if self._pending:
            self._append_pending()
        oldest, room = needed_from_ns - int(memory_s * 1e9), self._room
        if self._end > self._first and room.stamps_ns[self._first] < oldest - int(0.4e9 * memory_s):
            self._first += int(np.searchsorted(room.stamps_ns[self._first : self._end], oldest))
        rows = slice(self._first, self._end)
        self.imu = ImuSamples(room.stamps_ns[rows], room.gyro_radps[rows], room.accel_mps2[rows])
        serves_ns = oldest if len(self.imu) else needed_from_ns - _WHEEL_REACH_NS
        if self._wheel and self._wheel[0].stamp_ns < serves_ns:
            self._wheel = [s for s in self._wheel if s.stamp_ns >= serves_ns]

    def _append_pending(self) -> None:
        known = self._end
        most = known + sum(len(batch) for batch in self._pending)
        if most > len(self._room):
            held = most - self._first
            old, self._room = self._room, _room_for(max(2 * held, _LEAST_ROOM))
            for to, rows in zip(_columns(self._room), _columns(old), strict=True):
                to[: known - self._first] = rows[self._first : known]
            self._first, known = 0, known - self._first
        end = known
        for batch in self._pending:
            for to, rows in zip(_columns(self._room), _columns(batch), strict=True):
                to[end : end + len(batch)] = rows
            end += len(batch)
        self._pending.clear()
        self._end = sensor_kernels.drop_spikes(*_columns(self._room), self._first, known, end)

    def rotation_between(self, start_ns: int, end_ns: int, noise: ImuNoise) -> Array | None:
        """earlier_from_later (3, 3) of the body by the gyro, its bias included; None where samples are missing."""
        if sensor_kernels.longest_gap_ns(self.imu.stamps_ns, start_ns, end_ns) > IMU_GAP_NS:
            return None
        return preintegrate(self.imu, start_ns, end_ns, np.zeros(3), np.zeros(3), noise).delta_rotation

    @property
    def on_wheels(self) -> bool:
        """Whether wheel odometry came lately: the robot stands on a floor."""
        return bool(self._wheel)

    def wheel_between(self, start_ns: int, end_ns: int) -> list[WheelSample]:
        """The wheel samples from start_ns until end_ns that are still there; none is taken."""
        return [sample for sample in self._wheel if start_ns <= sample.stamp_ns <= end_ns]

    def take_wheel(self, stamp_ns: int) -> tuple[WheelSample, Array] | None:
        """The wheel sample nearest to a moment with the mean gyro (3,) around it; None where none is near.

        Samples up to that moment are dropped.
        """
        if not self._wheel:
            return None
        sample = min(self._wheel, key=lambda s: abs(s.stamp_ns - stamp_ns))
        around = self.imu.between(sample.stamp_ns - 5_000_000, sample.stamp_ns + 5_000_001)
        self._wheel = [s for s in self._wheel if s.stamp_ns > stamp_ns]
        if abs(sample.stamp_ns - stamp_ns) > _WHEEL_REACH_NS or not len(around):
            return None
        return sample, np.asarray(around.gyro_radps.mean(axis=0))


def _columns(samples: ImuSamples) -> tuple[Stamps, Array, Array]:
    return samples.stamps_ns, samples.gyro_radps, samples.accel_mps2


def _room_for(count: int) -> ImuSamples:
    return ImuSamples(np.empty(count, np.int64), np.empty((count, 3)), np.empty((count, 3)))
