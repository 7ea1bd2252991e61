"""A robot's estimate of its pose, frame by frame."""

from dataclasses import dataclass

from fleetmap.geometry import Array
from fleetmap.messages import Cause, Status
from fleetmap.odometry import OdometryEstimate
from fleetmap.relocalization.relocalizer import Fix
from locclient.localization.calibration.parameters import NOT_JUDGED, CalibrationState
from locclient.localization.image_quality import GOOD_IMAGE, ImageQuality


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A pose that the robot may have, map_from_body (4, 4), and the number of fixes that support it."""

    map_from_body: Array
    support: int


@dataclass(frozen=True, slots=True)
class Estimate:
    """Pose of the body at one frame, with what led to it.

    map_from_body (4, 4), cov_rot_trans (6, 6): map axes, rotation first; None while unknown. cause: what stands in the way of TRACKING;
    image: quality of the frame's images, with their own cause, also while TRACKING. fix: the one that was finished with this frame, taken
    from the frame of fix_stamp_ns, which may be a few frames older. refused: why a fix was not used. innovation: squared Mahalanobis
    distance between fix and prediction; innovation_m: metres, for fixes that were believed or found where the robot should be. moved_m: for
    a pose confirmed with this frame, its distance from the pose that was claimed until fixes contradicted it, where that is more than its
    covariance admits: one of the two was wrong. hypotheses: the competing poses while AMBIGUOUS. stage_s: seconds by stage, by the clock
    that was passed in. calibration: what the map shows of it.
    """

    stamp_ns: int
    status: Status
    map_from_body: Array | None
    cov_rot_trans: Array | None
    map_version: int | None
    fix: Fix | None
    refused: str
    innovation: float | None
    hypotheses: tuple[Hypothesis, ...]
    odometry: OdometryEstimate
    stage_s: dict[str, float]
    cause: Cause = Cause.NONE
    image: ImageQuality = GOOD_IMAGE
    fix_stamp_ns: int | None = None
    innovation_m: float | None = None
    moved_m: float | None = None
    calibration: CalibrationState = NOT_JUDGED
