"""Faults, by name and time. To add one: a line in FAULTS and its effect below."""

import math
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.errors import UsageError, chosen
from fleetmap.sensors.samples import ImuSamples, WheelSample
from fleetsim.sensors.measurements import START_NS

FAULTS = {
    "camera-dark": "both cameras see nothing",
    "camera-frozen": "the right camera repeats its last picture",
    "frames-dropped": "frames do not arrive",
    "frames-late": "frames are stamped 50 ms late",
    "imu-gap": "no IMU samples",
    "imu-spike": "one wild IMU sample",
    "over-exposure": "eight times too much gain",
    "person-in-front": "a person stands 0.8 m before the cameras",
    "wheel-slip": "the wheels turn 1.6 times as fast as the robot moves",
}
LATE_S, OVER_EXPOSURE, SLIP = 0.05, 8.0, 1.6


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault in force from start_s to end_s of a recording."""

    name: str
    start_s: float
    end_s: float

    def covers(self, time_s: float) -> bool:
        """True if it is active."""
        return self.start_s <= time_s < self.end_s


def parse_fault(text: str) -> Fault:
    """Parse a fault written as NAME@START+DURATION, seconds; UsageError otherwise."""
    name, _, times = text.partition("@")
    start, _, duration = times.partition("+")
    chosen("fault", name, FAULTS)
    try:
        start_s, duration_s = float(start), float(duration or 1.0)
    except ValueError as error:
        wanted = "NAME@START+DURATION in seconds, such as camera-dark@8+2"
        raise UsageError(f"fault {text!r} should read {wanted}") from error
    if not (0 <= start_s < math.inf and 0 < duration_s < math.inf):
        raise UsageError(f"fault {text!r} needs a start of 0 s or later and a duration above 0 s")
    return Fault(name, start_s, start_s + duration_s)


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """All faults of one recording."""

    faults: tuple[Fault, ...] = ()

    def has(self, name: str, time_s: float) -> bool:
        """True if a fault of that name is active."""
        return any(fault.name == name and fault.covers(time_s) for fault in self.faults)

    def spoil_imu(self, samples: ImuSamples) -> ImuSamples:
        """Remove samples in gaps and insert spikes: one sample of 20 rad/s and 60 m/s^2 per fault."""
        times = (samples.stamps_ns - START_NS) * 1e-9
        gyro, accel = samples.gyro_radps.copy(), samples.accel_mps2.copy()
        for fault in self.faults:
            if fault.name == "imu-spike" and len(times):
                index = min(int(np.searchsorted(times, fault.start_s)), len(times) - 1)
                gyro[index] += (20.0, -20.0, 20.0)
                accel[index] += (60.0, 60.0, -60.0)
        kept = np.array([not self.has("imu-gap", float(time_s)) for time_s in times], bool)
        return ImuSamples(samples.stamps_ns[kept], gyro[kept], accel[kept])

    def spoil_wheels(self, samples: tuple[WheelSample, ...]) -> tuple[WheelSample, ...]:
        """The samples with slip."""
        return tuple(
            replace(sample, velocity_base_mps=sample.velocity_base_mps * SLIP)
            if self.has("wheel-slip", (sample.stamp_ns - START_NS) * 1e-9)
            else sample
            for sample in samples
        )
