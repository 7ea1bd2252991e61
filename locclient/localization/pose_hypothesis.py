"""Pose hypotheses that the odometry propagates from frame to frame. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, length
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from locclient.localization.alias_disambiguation import ObservationHistory
from locclient.localization.place import ORIGIN, Place, bounded_turn, boxminus
from locclient.localization.settings import TrackSettings

# Sigmas of one step: radians, metres, share of the distance.
MEASURED_DRIFT, RESTARTED = (0.0005, 0.001, 0.02), (0.02, 0.05, 0.1)
_VISION_ONLY = (0.005, 0.02, 0.1)  # without an IMU a few wrong points can rotate the motion


class Motion(NamedTuple):
    """Odometry motion from a frame to the present one: body_from_now (4, 4), its covariance (6, 6), a left perturbation in the
    body's axes; is_last: the odometry drops the start frame with the next frame."""

    body_from_now: Array
    cov_rot_trans: Array
    is_last: bool


@dataclass
class PoseHypothesis:
    """Place of the body at one frame of the odometry, and its support.

    start: at that frame. now: propagated to the present. then: at the frame of the present map query, which may be some frames old.
    stamp_ns: of the last fix. support: number of agreeing fixes. inlier_sum, recall_sum, queries: sums of inliers, of landmark recall, and
    of map queries, older ones decayed. query_inliers, query_recall: of this query's fix, 0 without. recall_total, looks: landmark recall of
    all queries, 0 for those without a fix, and their number. misses: queries since the last fix. told_log_odds: log odds that an operator
    who chose this place is right, 0 without one. has_broken: tracks were lost since the last fix, lost_imu: so was the IMU, for longer than
    images alone are believed, missed: so were frames. is_by_vision: it moved without an IMU since its frame.
    """

    frame_index: int
    stamp_ns: int
    start: Place
    now: Place
    then: Place = ORIGIN
    support: int = 1
    inlier_sum: float = 0.0
    recall_sum: float = 0.0
    queries: float = 0.0
    query_inliers: int = 0
    query_recall: float = 0.0
    recall_total: float = 0.0
    looks: int = 0
    misses: int = 0
    travelled_m: float = 0.0
    told_log_odds: float = 0.0
    has_broken: bool = False
    lost_imu: bool = False
    missed: bool = False
    is_by_vision: bool = False
    history: ObservationHistory = field(default_factory=ObservationHistory)

    @classmethod
    def at(cls, odometry: OdometryEstimate, place: Place = ORIGIN) -> "PoseHypothesis":
        return cls(odometry.frame_index, odometry.stamp_ns, place, place)

    @classmethod
    def at_query(cls, query: "PoseHypothesis", place: Place) -> "PoseHypothesis":
        """Propagate a place at the frame of a map query to the present. query: the origin at that frame, propagated to the present."""
        ways = place.at_end_of(query.start), place.at_end_of(query.now)
        fresh = cls(query.frame_index, query.stamp_ns, *ways, has_broken=query.has_broken)
        fresh.lost_imu, fresh.missed, fresh.is_by_vision = query.lost_imu, query.missed, query.is_by_vision
        return fresh

    @property
    def evidence(self) -> str:
        """Text of the supporting evidence."""
        return f"{self.mean_inliers:.0f} matches, {self.mean_recall:.0%} of the expected landmarks"

    @property
    def mean_inliers(self) -> float:
        return self.inlier_sum / max(self.queries, 1.0)

    @property
    def mean_recall(self) -> float:
        return self.recall_sum / max(self.queries, 1.0)

    @property
    def recall(self) -> float:
        return self.recall_total / max(self.looks, 1)

    def is_same_pose(self, fresh: "PoseHypothesis", settings: TrackSettings) -> bool:
        error, covariance = boxminus(fresh.now.map_from_body, self.now.map_from_body), self.now.cov_rot_trans
        far_m = settings.hypothesis_distance_m + 3 * np.sqrt(np.trace(covariance[3:, 3:]))
        far_rad = np.radians(settings.hypothesis_angle_deg) + 3 * np.sqrt(np.trace(covariance[:3, :3]))
        is_near = bool(np.linalg.norm(error[3:]) < far_m and np.linalg.norm(error[:3]) < far_rad)
        return is_near and fresh.now.shares_map(self.now)

    def speaks_against_others(self, settings: TrackSettings) -> bool:
        """Return True if its fixes may contradict a confirmed pose: strong ones, or ones that moved with the robot, farther than the
        scatter of fixes at one place.

        Racks repeat: weak fixes of a standing robot at another place count as one, however many there are.
        """
        return self.mean_inliers >= settings.strong_inliers or self.travelled_m >= settings.hypothesis_distance_m

    def decay(self, kept_share: float) -> None:
        """Reduce the weight of older queries when a map query begins."""
        self.inlier_sum, self.recall_sum = kept_share * self.inlier_sum, kept_share * self.recall_sum
        self.queries = kept_share * self.queries + 1.0
        self.query_inliers, self.query_recall = 0, 0.0
        self.looks += 1

    def add_fix(self, inliers: int, landmark_recall: float) -> None:
        self.inlier_sum += inliers
        self.recall_sum += landmark_recall
        self.recall_total += landmark_recall
        self.query_inliers, self.query_recall = inliers, landmark_recall

    def take_pose(self, other: "PoseHypothesis") -> None:
        """Adopt the pose of another hypothesis, and keep the own support."""
        self.frame_index, self.stamp_ns = other.frame_index, other.stamp_ns
        self.start, self.now = other.start, other.now
        self.is_by_vision = other.is_by_vision

    def propagate(
        self, motions: Mapping[int, Motion], odometry: OdometryEstimate, step: Array, settings: TrackSettings
    ) -> None:
        """Propagate to the present frame, by the motion since the start frame if the odometry has it, else by `step` (4, 4) from the last.

        The start frame becomes the present one before the odometry drops it.
        """
        step_m = length(step[:3, 3])
        self.travelled_m += step_m
        self.is_by_vision |= odometry.is_bridged or not odometry.inertial
        motion = motions.get(self.frame_index)
        if motion is None:
            # The odometry dropped the start frame in a long standstill, or restarted: one step by its estimates alone.
            is_lost = odometry.status is OdometryStatus.DEGRADED or odometry.new_odom_from_old_odom is not None
            is_sure = odometry.scale_known and not is_lost
            self.now = self.now.moved(step, step_cov(MEASURED_DRIFT if is_sure else RESTARTED, step_m))
        else:
            distance_m = length(motion.body_from_now[:3, 3])
            usual = settings.drift_rad, settings.drift_floor_m, settings.drift_share
            drift = _VISION_ONLY if self.is_by_vision else usual
            self.now = self.start.moved(motion.body_from_now, motion.cov_rot_trans + step_cov(drift, distance_m))
        if motion is None or motion.is_last:
            self.frame_index, self.is_by_vision = odometry.frame_index, False
            self.start = self.now._replace(cov_rot_trans=bounded_turn(self.now.cov_rot_trans))


def step_cov(sigmas: tuple[float, float, float], distance_m: float) -> Array:
    """Return the covariance (6, 6) of a step, rotation first, by sigmas in radians, metres, and as a share of the distance."""
    turn_rad, floor_m, share = sigmas
    return np.diag([turn_rad**2] * 3 + [(floor_m + share * distance_m) ** 2] * 3)
