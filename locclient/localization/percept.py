"""What a robot perceives with one frame, before a map says where that is. Robots keep it, and replays of failures have it again. Pure."""

from dataclasses import dataclass

from fleetmap.messages import Cause
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.relocalization.frame_features import FrameFeatures
from locclient.localization.calibration.parameters import NOT_JUDGED, CalibrationState
from locclient.localization.image_quality import ImageQuality
from locclient.localization.pose_hypothesis import Motion


@dataclass(slots=True)
class QueryInput:
    """The features of a frame with which a map query begins, and in how many slices they were extracted; None until they all are."""

    slices: int = 0
    features: FrameFeatures | None = None


@dataclass(slots=True)
class Percept:
    """One frame.

    motions: of the odometry, from frames that hypotheses began with. is_reversed: left and right image are exchanged or mirrored.
    calibration: what the map showed of it until this frame. query: of a map query that begins with this frame.
    """

    odometry: OdometryEstimate
    image: ImageQuality
    motions: dict[int, Motion]
    is_reversed: bool = False
    calibration: CalibrationState = NOT_JUDGED
    query: QueryInput | None = None

    @property
    def has_broken(self) -> bool:
        """Tracks are lost though the picture is sound: something came before the cameras, or the robot is elsewhere."""
        return self.odometry.status is OdometryStatus.DEGRADED and self.image.cause is Cause.NONE
