"""Sensor samples. Stamps are `stamp_ns` on the sensor clock."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, Array32, interpolate_se3

Image = NDArray[np.uint8]
Stamps = NDArray[np.int64]
# A longer time without images is a pause, over which no motion is propagated: with an accelerometer error of 0.03 m/s^2, as good ones of
# robots have, a position drifts 1.5 m in 10 s, growing with the square of the time, and a speed does not predict the motion after a stop.
PAUSE_NS = 10_000_000_000
INTEGRATED_NS = 60_000_000_000  # complete inertial samples allow a longer time; the drift in a minute is 54 m


class SensorSet(StrEnum):
    """Sensors of a recording, recognised from its content."""

    STEREO_INERTIAL = "stereo-inertial"
    STEREO = "stereo"
    RGBD = "rgbd"
    MONO_INERTIAL = "mono-inertial"
    MONO = "mono"


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """N inertial samples in `body` axes, stamps strictly increasing.

    stamps_ns (N,), gyro_radps (N, 3), accel_mps2 (N, 3): specific force, +9.81 upwards at rest.
    """

    stamps_ns: Stamps
    gyro_radps: Array
    accel_mps2: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    def empty(cls) -> "ImuSamples":
        """No samples."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))

    def between(self, start_ns: int, end_ns: int) -> "ImuSamples":
        """Samples with start_ns <= stamp < end_ns."""
        a, b = self.stamps_ns.searchsorted((start_ns, end_ns))
        return ImuSamples(self.stamps_ns[a:b], self.gyro_radps[a:b], self.accel_mps2[a:b])


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """One moment of the camera rig, as recorded (not rectified).

    left: (H, W) uint8 grey. right: the same for the second camera, None without one. depth_m: (H, W) float32 registered to
    `left`, 0 or NaN where unknown, None without a depth sensor. others: the same of the rig's other views (`RigCalibration.views`),
    None for one without images.
    """

    stamp_ns: int
    left: Image
    right: Image | None = None
    depth_m: Array32 | None = None
    others: "tuple[CameraFrame | None, ...]" = ()


@dataclass(frozen=True, slots=True)
class WheelSample:
    """Wheel odometry: velocity in `base` axes, forward/left/up m/s (3,) and yaw rate, with their standard deviations."""

    stamp_ns: int
    velocity_base_mps: Array
    yaw_rate_radps: float
    sigma_mps: float
    sigma_radps: float


def wheel_between(samples: Sequence[WheelSample], start_ns: int, end_ns: int) -> Sequence[WheelSample]:
    """Samples with start_ns <= stamp < end_ns, from samples in order of their stamps."""
    first = bisect_left(samples, start_ns, key=lambda sample: sample.stamp_ns)
    return samples[first : bisect_left(samples, end_ns, lo=first, key=lambda sample: sample.stamp_ns)]


@dataclass(frozen=True, slots=True)
class PositionPrior:
    """A coarse pose in `map` from a dock, tag, zone or operator.

    map_from_base (4, 4); cov_rot_trans (6, 6) of a perturbation in map axes; infinite where unknown. is_revisable: from an operator, who
    may err: it replaces the robot's estimate, and fixes may contradict it. floor: whose `map` it is in, of a building; empty for the
    robot's own site, None for the floor where it is. is_measured: of a revisable one, that a sensor told it, which errs otherwise than by
    taking one of several alike places for another.
    """

    stamp_ns: int
    map_from_base: Array
    cov_rot_trans: Array
    is_revisable: bool = False
    floor: str | None = None
    is_measured: bool = False


# Default sigmas of an operator's pose: roll pitch yaw (rad), x y z (m). Yaw, x and y are those of RViz.
UNSAID_SIGMAS = np.array([0.05, 0.05, np.radians(15.0), 0.5, 0.5, 0.25])


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Stamped transforms of the body: stamps_ns (N,) increasing, frame_from_body (N, 4, 4)."""

    stamps_ns: Stamps
    frame_from_body: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions_m(self) -> Array:
        """(N, 3) metres."""
        return np.asarray(self.frame_from_body[:, :3, 3])

    def at(self, stamp_ns: int, max_gap_ns: int = 200_000_000) -> Array | None:
        """Interpolate frame_from_body at `stamp_ns`; None outside, or inside a gap longer than `max_gap_ns`."""
        index = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if index < len(self) and self.stamps_ns[index] == stamp_ns:
            return np.asarray(self.frame_from_body[index])
        if index in (0, len(self)):
            return None
        before, after = int(self.stamps_ns[index - 1]), int(self.stamps_ns[index])
        if after - before > max_gap_ns:
            return None
        fraction = (stamp_ns - before) / (after - before)
        return interpolate_se3(self.frame_from_body[index - 1], self.frame_from_body[index], fraction)


@dataclass(frozen=True, slots=True)
class DataIssue:
    """A fault of a recording's data: its kind, and details as text."""

    what: str
    detail: str = field(default="")
