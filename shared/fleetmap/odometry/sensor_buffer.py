"""Buffer of IMU and wheel samples that may still be needed."""

from collections.abc import Sequence

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array
from fleetmap.inertial import preintegrate
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import INTEGRATED_NS, PAUSE_NS, ImuSamples, Stamps, WheelSample

IMU_GAP_NS = 35_000_000  # a longer gap is bridged as without an IMU; an IMU of 30 Hz has no such gaps
_WHEEL_REACH_NS = 30_000_000  # a sample serves a frame within half the period of slow wheel odometry
_FOR_EVER_NS = 1 << 62
_NOISY_SAMPLES = 100  # none equal to the one before: the gyro's noise exceeds its resolution, and one that repeats a sample is frozen


def is_pause(imu_stamps_ns: Stamps, start_ns: int, end_ns: int) -> bool:
    """True if no motion is propagated between two moments, both on the IMU's clock; complete samples allow a longer time."""
    is_missing = core.longest_gap_ns(imu_stamps_ns, start_ns, end_ns) > IMU_GAP_NS
    return end_ns - start_ns > (PAUSE_NS if is_missing else INTEGRATED_NS)


class SensorBuffer:
    """Samples in order of their stamps, on the IMU's clock, without spikes and a frozen gyro. Arrays of `imu` are never written again."""

    def __init__(self) -> None:
        self.imu = ImuSamples.empty()
        self._pending: list[ImuSamples] = []
        self._wheel: list[WheelSample] = []
        self._last_gyro_radps = np.full((1, 3), np.nan)
        # Samples known to have no repeated one before them; never enough for a coarse gyro, which repeats some.
        self._unequal = 0.0

    def add_imu(self, samples: ImuSamples) -> None:
        """Add samples newer than any before; `imu` has them after `absorb`."""
        self._pending.append(samples)

    def add_wheel(self, samples: Sequence[WheelSample]) -> None:
        """Add samples newer than any before."""
        self._wheel.extend(samples)

    def absorb(self, needed_from_ns: int, memory_s: float) -> None:
        """Append new samples; drop IMU samples older than memory_s before needed_from_ns once they are many, and wheel samples as old.

        Without an IMU wheels serve no start: all samples that serve no frame from needed_from_ns on are dropped.
        """
        if self._pending:
            parts = [self.imu, *map(self._not_frozen, self._pending)]
            stamps_ns = np.concatenate([part.stamps_ns for part in parts])
            gyro_radps = np.concatenate([part.gyro_radps for part in parts])
            accel_mps2 = np.concatenate([part.accel_mps2 for part in parts])
            end = core.drop_spikes(stamps_ns, gyro_radps, accel_mps2, len(self.imu))
            self.imu = ImuSamples(stamps_ns[:end], gyro_radps[:end], accel_mps2[:end])
            self._pending.clear()
        oldest = needed_from_ns - int(memory_s * 1e9)
        if len(self.imu) and self.imu.stamps_ns[0] < oldest - int(0.4e9 * memory_s):
            self.imu = self.imu.between(oldest, _FOR_EVER_NS)
        serves_ns = oldest if len(self.imu) else needed_from_ns - _WHEEL_REACH_NS
        if self._wheel and self._wheel[0].stamp_ns < serves_ns:
            self._wheel = [s for s in self._wheel if s.stamp_ns >= serves_ns]

    def _not_frozen(self, samples: ImuSamples) -> ImuSamples:
        """Samples without those that a frozen gyro repeats to the bit: it measures nothing, and the gap is bridged."""
        gyro_radps = np.concatenate([self._last_gyro_radps, samples.gyro_radps])
        self._last_gyro_radps, is_new = gyro_radps[-1:], (gyro_radps[1:] != gyro_radps[:-1]).any(axis=1)
        if self._unequal >= _NOISY_SAMPLES:
            return ImuSamples(samples.stamps_ns[is_new], samples.gyro_radps[is_new], samples.accel_mps2[is_new])
        self._unequal += len(samples) if is_new.all() else -np.inf
        return samples

    def rotation_between(self, start_ns: int, end_ns: int, noise: ImuNoise) -> Array | None:
        """earlier_from_later (3, 3) of the body by the gyro, its bias included; None if samples are missing."""
        if core.longest_gap_ns(self.imu.stamps_ns, start_ns, end_ns) > IMU_GAP_NS:
            return None
        return preintegrate(self.imu, start_ns, end_ns, np.zeros(3), np.zeros(3), noise).delta_rotation

    @property
    def on_wheels(self) -> bool:
        """True if recent wheel odometry exists: the robot stands on the ground."""
        return bool(self._wheel)

    def wheel_between(self, start_ns: int, end_ns: int) -> list[WheelSample]:
        """Kept wheel samples from start_ns until end_ns; they stay in the buffer."""
        return [sample for sample in self._wheel if start_ns <= sample.stamp_ns <= end_ns]

    def take_wheel(self, stamp_ns: int) -> tuple[WheelSample, Array] | None:
        """Take the wheel sample nearest to a moment with the mean gyro (3,) around it; None if none is near.

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
