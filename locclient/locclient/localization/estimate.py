"""What a robot says of its place, frame by frame."""

from dataclasses import dataclass

from fleetmap.geometry import Array
from fleetmap.messages import Cause, Status
from fleetmap.odometry import OdometryEstimate
from fleetmap.relocalization.relocalizer import Fix


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A place where the robot may be: map_from_body (4, 4) and how many fixes spoke for it."""

    map_from_body: Array
    support: int


@dataclass(frozen=True, slots=True)
class Estimate:
    """Where the body is.

    map_from_body (4, 4) and cov_rot_trans (6, 6) (map axes, rotation first) are None until there is anything to say. cause: what
    stands in the way, NONE while TRACKING. fix: the one that was finished with this frame, None without one, taken from the
    frame of fix_stamp_ns, which may be a few frames old: looking at the map is spread over frames. refused: why a fix was not
    used. innovation: how far what the map says is from what was predicted, squared by its covariance; innovation_m: in metres, of what
    was found where the robot should be, or was believed. moved_m: how far a place that was confirmed with this frame is from the one
    that was said until fixes spoke against it, beyond its covariance, so that one of them was wrong; None else. hypotheses: what speaks for
    which place while AMBIGUOUS.
    stage_s: seconds by the clock that was passed in, for odometry and for looking at the map.
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
    fix_stamp_ns: int | None = None
    innovation_m: float | None = None
    moved_m: float | None = None
