"""Input of one step of a robot: a frame and the other samples up to it. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from fleetmap.messages import Flag
from fleetmap.recordings.images import StoredFrame
from fleetmap.sensors.samples import CameraFrame, ImuSamples, PositionPrior, WheelSample

IMU_LEAD_NS = 10_000_000  # a frame is handled once IMU samples slightly past it have arrived
NEVER_NS = -(2**62)


@dataclass(frozen=True, slots=True)
class SensorBundle:
    """A frame, None if none came in time, and the samples to handle before it. forget: first reset the pose estimate. dropped:
    number of frames between the one before and this one that came faster than they were taken. left_out: flags of sensors whose samples
    are not used because their clock was set back, with texts."""

    frame: CameraFrame | StoredFrame | None = None
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    wheel: list[WheelSample] = field(default_factory=list)
    priors: list[PositionPrior] = field(default_factory=list)
    forget: bool = False
    dropped: int = 0
    left_out: Mapping[Flag, str] = field(default_factory=dict)
