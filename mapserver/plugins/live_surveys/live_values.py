"""Values exchanged between tracking, the growing map and its viewers."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.messages import Cause, Status
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import ImuSamples
from mapserver.plugins.live_surveys.message import LivePart, LiveRevisit


@dataclass(frozen=True, slots=True)
class LiveRig:
    """Sensors of the survey: the rectified camera, its mount on the body, the IMU's noise (None if absent) and its clock."""

    camera: StereoCamera
    body_from_cam: Array
    imu_noise: ImuNoise | None = None
    imu_minus_cam_s: float = 0.0
    is_depth_camera: bool = False
    scale_known: bool = True  # False for one camera without an IMU


@dataclass(frozen=True, slots=True)
class NewKeyframe:
    """A frame chosen by the odometry.

    frame_from_body (4, 4) in odometry's continuous frame; level_from_frame (3, 3) makes that upright by the present gravity estimate.
    step_cov (6, 6): of the motion since the previous keyframe, axes of that one, rotation first; None for the first. velocity_body_mps
    and biases (3,); imu: samples since the previous keyframe. variance_m2: of the odometry's position, summed over the axes.
    """

    number: int
    frame_from_body: Array
    level_from_frame: Array
    step_cov: Array | None
    velocity_body_mps: Array
    gyro_bias_radps: Array
    accel_bias_mps2: Array
    inertial: bool = False
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    variance_m2: float = 0.0


@dataclass(frozen=True, slots=True)
class LiveLoops:
    """Loops so far: ends (L, 2) of accepted ones, keyframe numbers; numbers of refused candidates by reason.

    newest: for each of the latest keyframes that matched an old one, its best match, accepted or not.
    """

    believed: NDArray[np.int64]
    refused: dict[str, int]
    newest: tuple[LiveRevisit, ...] = ()


class LiveEstimate(NamedTuple):
    """Pose of the newest keyframe: map_from_body (4, 4) and its covariance (6, 6), map axes, rotation first; None while unknown."""

    keyframe: NewKeyframe
    status: Status
    cause: Cause
    map_from_body: Array | None
    cov_rot_trans: Array | None


class LiveParts(NamedTuple):
    """Parts of a survey that lost tracking: labels (K,) number them by time, -1 for keyframes that saw too little.

    Only one can be the map, the one with the most keyframes: parts still separate at the end are left out.
    """

    labels: NDArray[np.int64]
    spans: list[LivePart]


def joined_imu(parts: Sequence[ImuSamples]) -> ImuSamples:
    """Concatenate samples of consecutive parts."""
    return ImuSamples(
        np.concatenate([part.stamps_ns for part in parts]),
        np.concatenate([part.gyro_radps for part in parts]),
        np.concatenate([part.accel_mps2 for part in parts]),
    )
