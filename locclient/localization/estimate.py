"""A robot's estimate of its pose, frame by frame, and its assembly: status, pose with covariance, cause. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, NamedTuple

import numpy as np

from fleetmap.failure_definition import known_radius_m, radius_95_m
from fleetmap.geometry import Array
from fleetmap.messages import Cause, Status
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.relocalization.relocalizer import Fix
from locclient.localization.calibration.parameters import NOT_JUDGED, CalibrationState
from locclient.localization.image_quality import GOOD_IMAGE, ImageQuality
from locclient.localization.place import Place
from locclient.localization.pose_hypothesis import PoseHypothesis
from locclient.localization.pose_tracker import PoseTracker


class Hypothesis(NamedTuple):
    """A possible pose of the robot, map_from_body (4, 4), and the number of fixes that support it. floor: whose map, see `Estimate`;
    recall: share of the expected landmarks that they found."""

    map_from_body: Array
    support: int
    floor: str = ""
    recall: float = 0.0


@dataclass(frozen=True, slots=True)
class Estimate:
    """Pose of the body at one frame, with diagnostics.

    map_from_body (4, 4), cov_rot_trans (6, 6): map axes, rotation first; None if unknown. cause: reason why the status is not TRACKING;
    image: quality of the frame's images, with their own cause, also while TRACKING. fix: the one finished with this frame, of the frame
    at fix_stamp_ns, which may be a few frames older. refused: reason why a fix was not used. innovation: squared Mahalanobis
    distance between fix and prediction; innovation_m: metres, for fixes that were accepted or found at the predicted place. moved_m: for
    a pose confirmed with this frame, its distance from the pose that was claimed until fixes contradicted it, if beyond its
    covariance: one of the two was wrong. hypotheses: the competing poses while AMBIGUOUS. stage_s: seconds by stage, by the given
    clock. calibration: its state by the map. view_causes: faults of the images of each view of the rig, NONE for good ones;
    view: the one of the last map query.
    floor: site whose map the pose and map_version are of, in a building; empty for the robot's own. Without a pose the last known one.
    protection_m, protection_deg: the errors of position, of body and base, and of rotation are larger with a probability of at most
    `TrackSettings.protection_risk`; infinite where nothing can be promised.
    """

    stamp_ns: int
    odometry: OdometryEstimate
    map_version: int | None
    status: Status = Status.INITIALISING
    map_from_body: Array | None = None
    cov_rot_trans: Array | None = None
    fix: Fix | None = None
    refused: str = ""
    innovation: float | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    stage_s: dict[str, float] = field(default_factory=dict)
    cause: Cause = Cause.NONE
    image: ImageQuality = GOOD_IMAGE
    fix_stamp_ns: int | None = None
    innovation_m: float | None = None
    moved_m: float | None = None
    calibration: CalibrationState = NOT_JUDGED
    view_causes: tuple[Cause, ...] = (Cause.NONE,)
    view: int = 0
    floor: str = ""
    protection_m: float = inf
    protection_deg: float = inf

    @property
    def is_at_home(self) -> bool:
        """True if it is in the map of the robot's own site."""
        return not self.floor

    @property
    def protection(self) -> dict[str, float | None]:
        """Return the levels by name, for messages: None where nothing is promised."""
        named = {"protection_m": self.protection_m, "protection_deg": self.protection_deg}
        return {name: level if level < inf else None for name, level in named.items()}

    @property
    def in_words(self) -> str:
        """Return status, cause, version and uncertainty of the position."""
        cause = f" ({self.cause.value})" if self.cause.value else ""
        version = "no map" if self.map_version is None else f"version {self.map_version}"
        of_floor = f" of {self.floor}" if self.floor else ""
        radius_m = known_radius_m(self.cov_rot_trans)
        known = "" if radius_m is None else f", position known to {radius_m:.2f} m (95 %)"
        return f"{self.status.value}{cause}, {version}{of_floor}{known}"

    @property
    def views_in_words(self) -> str:
        """Return the state of each view, and which one is compared with the map; empty for a rig of one view."""
        states = [
            f"view {number}: {cause.value or 'good'}" + " (compared with the map)" * (number == self.view)
            for number, cause in enumerate(self.view_causes)
        ]
        return ", ".join(states) if len(states) > 1 else ""


def assemble(estimate: Estimate, tracker: PoseTracker, *, has_failed: bool) -> Estimate:
    """Return `estimate`, whose cause is that of its images, completed by status, pose and cause.

    has_failed: the last map query found no fix.
    """
    if tracker.confirmed is not None:
        return _of_confirmed(estimate, tracker, tracker.confirmed, has_failed)
    candidates, prior, settings = tracker.candidates, tracker.prior, tracker.settings
    ranking, competitors = candidates.ranking()
    is_open = bool(competitors) or (bool(ranking) and candidates.may_be_lookalike(ranking[0]))
    status = Status.AMBIGUOUS if is_open else Status.LOST if tracker.was_tracking else Status.INITIALISING
    estimate = replace(estimate, status=status, hypotheses=_published(ranking))
    rides = [] if prior is None or prior.names_floor or is_open else prior.places()
    if rides:
        places = tuple(Hypothesis(place.map_from_body, 1, place.floor) for place in rides)
        return replace(estimate, status=Status.AMBIGUOUS, hypotheses=places)
    known = None if prior is None else prior.hypothesis
    if ranking and (is_open or known is None or not tracker.was_tracking):
        return estimate if is_open else _with_pose(estimate, tracker, ranking[0].now)
    if known is None or estimate.map_version is None:
        return estimate
    # Nothing in the map matches: use the prior and the odometry since, within its accuracy.
    if radius_95_m(known.now.cov_rot_trans) <= settings.lost_radius_m:
        status = Status.DEGRADED
    return _with_pose(estimate, tracker, known.now, status=status, cause=_cause(estimate, has_failed=True))


def _cause(estimate: Estimate, *, has_failed: bool) -> Cause:
    if estimate.cause or estimate.odometry.status is OdometryStatus.DEGRADED:
        return estimate.cause or Cause.ODOMETRY
    return Cause.UNMATCHED if has_failed else Cause.NONE


def _of_confirmed(estimate: Estimate, tracker: PoseTracker, confirmed: PoseHypothesis, has_failed: bool) -> Estimate:
    elsewhere, settings = tracker.candidates.hypotheses, tracker.settings
    is_known = not np.isnan(confirmed.now.map_from_body).any()
    radius_m = radius_95_m(tracker.maps.with_error(confirmed.now).cov_rot_trans) if is_known else float("inf")
    is_late = (estimate.odometry.stamp_ns - confirmed.stamp_ns) * 1e-9 > settings.degraded_after_s
    is_broken = confirmed.has_broken or confirmed.lost_imu
    cause = _cause(estimate, has_failed=has_failed) or (Cause.ODOMETRY if is_broken else Cause.NONE)
    told = [h for h in elsewhere if h.speaks_against_others(settings)]
    is_moved = any(not confirmed.is_same_pose(h, settings) for h in told)
    # Its tracks or its IMU were lost, and the map has not confirmed its place since; or frames, and the map shows another one since.
    is_doubted = is_broken or (confirmed.missed and is_moved)
    if radius_m > settings.lost_radius_m:
        status = Status.LOST
    elif radius_m > settings.degraded_radius_m or is_late or cause is Cause.FROZEN or is_doubted:
        status = Status.DEGRADED
    else:
        status, cause = Status.TRACKING, Cause.NONE
    if status is not Status.TRACKING and told:  # the robot may be at either
        hypotheses = _published([confirmed, *elsewhere])
        return replace(estimate, status=Status.AMBIGUOUS, cause=cause, hypotheses=hypotheses)
    return _with_pose(estimate, tracker, confirmed.now, status=status, cause=cause)


def _with_pose(estimate: Estimate, tracker: PoseTracker, place: Place, **changes: Any) -> Estimate:
    """Add the pose, with the map's own error, beside other changes. The estimate has no pose if pose or covariance contain NaN."""
    if not (np.isnan(place.map_from_body).any() or np.isnan(place.cov_rot_trans).any()):
        changes |= tracker.maps.with_error(place)._asdict()
    return replace(estimate, **changes)


def _published(hypotheses: Sequence[PoseHypothesis]) -> tuple[Hypothesis, ...]:
    return tuple(Hypothesis(h.now.map_from_body, h.support, h.now.floor, h.recall) for h in hypotheses)
