"""Percept: measurements of one frame that do not depend on a map. Robots store them for replays of failures. Pure."""

from dataclasses import dataclass

from fleetmap.messages import Cause
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.relocalization.frame_features import FrameFeatures
from locclient.localization.calibration.parameters import NOT_JUDGED, CalibrationState
from locclient.localization.image_quality import ImageQuality
from locclient.localization.pose_hypothesis import Motion
from locclient.localization.priors.ride_gauge import Ride


@dataclass(slots=True)
class QueryInput:
    """Features of the frame of a map query, and the number of slices of their extraction; None until they are complete.

    view: number of the rig's view that they are of.
    """

    slices: int = 0
    features: FrameFeatures | None = None
    view: int = 0


@dataclass(slots=True)
class Percept:
    """Percept of one frame.

    motions: of the odometry, from start frames of hypotheses. is_reversed: images of a pair or of two cameras are exchanged, or mirrored.
    calibration: its state by the map before this frame. query: of a map query that begins with this frame. image: of the view that the
    odometry follows; view_causes: faults of the images of each view. ride: motion in a lift, None for a robot without a building.
    """

    odometry: OdometryEstimate
    image: ImageQuality
    motions: dict[int, Motion]
    is_reversed: bool = False
    calibration: CalibrationState = NOT_JUDGED
    query: QueryInput | None = None
    view_causes: tuple[Cause, ...] = (Cause.NONE,)
    ride: Ride | None = None

    @property
    def has_broken(self) -> bool:
        """True if tracks are lost in a good image: an object moved in front of the cameras, or the robot is elsewhere."""
        return self.odometry.status is OdometryStatus.DEGRADED and self.image.cause is Cause.NONE
