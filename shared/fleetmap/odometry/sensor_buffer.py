"""IMU and wheel samples that came and may still be needed."""

from collections.abc import Sequence

import numpy as np

from fleetmap.geometry import Array
from fleetmap.odometry.odometry_checks import joined, without_spikes
from fleetmap.sensors.samples import ImuSamples, WheelSample

_WHEEL_REACH_NS = 30_000_000  # a sample serves a frame within half the period of slow wheel odometry


class SensorBuffer:
    """Samples in order of their stamps, on the IMU's clock; spikes of the IMU are left out."""

    def __init__(self) -> None:
        self.imu = ImuSamples.empty()
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
            self.imu = without_spikes(self.imu, joined(self._pending))
            self._pending.clear()
        oldest = needed_from_ns - int(memory_s * 1e9)
        if len(self.imu) and self.imu.stamps_ns[0] < oldest - int(0.4e9 * memory_s):
            self.imu = self.imu.between(oldest, int(self.imu.stamps_ns[-1]) + 1)
        serves_ns = oldest if len(self.imu) else needed_from_ns - _WHEEL_REACH_NS
        if self._wheel and self._wheel[0].stamp_ns < serves_ns:
            self._wheel = [s for s in self._wheel if s.stamp_ns >= serves_ns]

    def wheel_between(self, start_ns: int, end_ns: int) -> list[WheelSample]:
        """The wheel samples from start_ns until end_ns that are still there; none is taken."""
        return [sample for sample in self._wheel if start_ns <= sample.stamp_ns <= end_ns]

    def take_wheel(self, stamp_ns: int) -> tuple[WheelSample, Array] | None:
        """The wheel sample nearest to a moment with the mean gyro (3,) around it; None where none is near.

        Samples up to that moment are dropped.
        """
        if not self._wheel:
            return None
        stamps = np.array([sample.stamp_ns for sample in self._wheel])
        sample = self._wheel[int(np.abs(stamps - stamp_ns).argmin())]
        around = self.imu.between(sample.stamp_ns - 5_000_000, sample.stamp_ns + 5_000_001)
        self._wheel = [s for s in self._wheel if s.stamp_ns > stamp_ns]
        if abs(sample.stamp_ns - stamp_ns) > _WHEEL_REACH_NS or not len(around):
            return None
        return sample, np.asarray(around.gyro_radps.mean(axis=0))
