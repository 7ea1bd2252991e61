"""Places that are carried along by the odometry, and the algebra of their covariances (rotation first, map axes, about the body)."""

from dataclasses import dataclass, field

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log
from fleetmap.odometry import Odometry, OdometryEstimate, OdometryStatus
from locclient.localization.alias_disambiguation import Tally
from locclient.localization.settings import TrackSettings

# Sigmas of one step: radians, metres, share of the way.
_STANDING, _BEGUN_ANEW = (0.0005, 0.001, 0.02), (0.02, 0.05, 0.1)
_BY_SIGHT = (0.005, 0.02, 0.1)  # of a motion that no IMU vouches for: a few wrong points can turn it


@dataclass
class PoseHypothesis:
    """Where the body was in `map` at one frame of the odometry, and everything that speaks for it.

    map_from_body and cov_rot_trans: at that frame. now_map_from_body, now_cov: the same carried to the present. then_map_from_body,
    then_cov: at the frame that the map is being looked at for, which may be some frames ago. stamp_ns: of its last fix. support: fixes
    that agreed; evidence: their inliers, older ones fading; inliers, hits: their mean over all looks since the first, and that of
    their share of what should have been seen, nothing where there was no fix.
    """

    frame_index: int
    stamp_ns: int
    map_from_body: Array
    cov_rot_trans: Array
    now_map_from_body: Array
    now_cov: Array
    then_map_from_body: Array = field(default_factory=lambda: np.eye(4))
    then_cov: Array = field(default_factory=lambda: np.zeros((6, 6)))
    support: int = 1
    evidence: float = 0.0
    hit_evidence: float = 0.0
    looks: float = 0.0
    misses: int = 0
    travelled_m: float = 0.0
    strangers: list["PoseHypothesis"] = field(default_factory=list)
    tally: Tally = field(default_factory=Tally)

    @classmethod
    def at(cls, odometry: OdometryEstimate, map_from_body: Array, cov_rot_trans: Array) -> "PoseHypothesis":
        """At the present frame."""
        return cls(odometry.frame_index, odometry.stamp_ns, map_from_body, cov_rot_trans, map_from_body, cov_rot_trans)

    @classmethod
    def behind(cls, moment: "PoseHypothesis", map_from_body: Array, cov_rot_trans: Array) -> "PoseHypothesis":
        """A place of the frame at which `moment` began as the identity, carried to the present as that was."""
        return cls(
            moment.frame_index, moment.stamp_ns,
            *chained(map_from_body, cov_rot_trans, moment.map_from_body, moment.cov_rot_trans),
            *chained(map_from_body, cov_rot_trans, moment.now_map_from_body, moment.now_cov),
        )  # fmt: skip

    @property
    def inliers(self) -> float:
        """Mean over the looks, later ones counting more."""
        return self.evidence / max(self.looks, 1.0)

    @property
    def hits(self) -> float:
        """Mean over the looks, later ones counting more."""
        return self.hit_evidence / max(self.looks, 1.0)

    def fade(self, kept_share: float) -> None:
        """One more look, in which it has not spoken yet."""
        self.evidence, self.hit_evidence = kept_share * self.evidence, kept_share * self.hit_evidence
        self.looks = kept_share * self.looks + 1.0

    def speak(self, inliers: int, landmark_recall: float) -> None:
        """A fix of this look was there."""
        self.evidence += inliers
        self.hit_evidence += landmark_recall

    def mark(self) -> None:
        """Remembers the present for the look that begins now."""
        self.then_map_from_body, self.then_cov = self.now_map_from_body, self.now_cov

    def moved_to(self, other: "PoseHypothesis") -> None:
        """Takes over where another one is."""
        self.frame_index, self.stamp_ns = other.frame_index, other.stamp_ns
        self.map_from_body, self.cov_rot_trans = other.map_from_body, other.cov_rot_trans
        self.now_map_from_body, self.now_cov = other.now_map_from_body, other.now_cov

    def carry(self, tracker: Odometry, odometry: OdometryEstimate, step: Array, settings: TrackSettings) -> None:
        """To the present frame: from the anchor's own while the odometry holds it (exact), else on from the last frame by `step`.

        Anchors anew before the odometry forgets.
        """
        step_m = float(np.linalg.norm(step[:3, 3]))
        self.travelled_m += step_m
        motion = tracker.motion_since(self.frame_index)
        if motion is None:
            # Forgotten because the robot stood, or because the odometry began anew: one step on its estimates alone.
            is_sure = odometry.new_odom_from_old_odom is None and odometry.status is not OdometryStatus.DEGRADED
            turn_rad, way_m, share = _STANDING if is_sure else _BEGUN_ANEW
            doubt = np.diag([turn_rad**2] * 3 + [(way_m + share * step_m) ** 2] * 3)
            self.now_map_from_body, self.now_cov = composed(self.now_map_from_body, self.now_cov, step, doubt)
        else:
            distance = float(np.linalg.norm(motion[0][:3, 3]))
            floor = np.diag([0.0] * 3 + [(settings.drift_floor_m + settings.drift_share * distance) ** 2] * 3)
            if not odometry.inertial:
                turn_rad, way_m, share = _BY_SIGHT
                floor = np.diag([turn_rad**2] * 3 + [(way_m + share * distance) ** 2] * 3)
            self.now_map_from_body, self.now_cov = composed(
                self.map_from_body, self.cov_rot_trans, motion[0], motion[1] + floor
            )
        if motion is None or tracker.will_forget(self.frame_index):
            self.frame_index = odometry.frame_index
            self.map_from_body, self.cov_rot_trans = self.now_map_from_body, self.now_cov


def moved(cov_rot_trans: Array, lever_m: Array) -> Array:
    """The covariance of a point at `lever_m` from the one it was given for, on the same rigid thing; map axes."""
    carry = np.eye(6)
    carry[3:, :3] = -np.array(
        [[0, -lever_m[2], lever_m[1]], [lever_m[2], 0, -lever_m[0]], [-lever_m[1], lever_m[0], 0]]
    )
    return np.asarray(carry @ cov_rot_trans @ carry.T)


def composed(map_from_body: Array, covariance: Array, body_from_next: Array, cov_step: Array) -> tuple[Array, Array]:
    """map_from_next and its covariance: a place moved on by a step whose covariance is a left perturbation in the body's axes."""
    rotation = map_from_body[:3, :3]
    turn = np.kron(np.eye(2), rotation)
    return map_from_body @ body_from_next, moved(
        covariance + turn @ cov_step @ turn.T, rotation @ body_from_next[:3, 3]
    )


def chained(map_from_body: Array, covariance: Array, body_from_next: Array, cov_next: Array) -> tuple[Array, Array]:
    """As `composed` with the step's covariance about where it ends, in the body's axes: as of an anchor whose map is that body."""
    turn = np.kron(np.eye(2), map_from_body[:3, :3])
    lever = map_from_body[:3, :3] @ body_from_next[:3, 3]
    return map_from_body @ body_from_next, moved(covariance, lever) + turn @ cov_next @ turn.T


def led_back(
    map_from_body: Array, covariance: Array, earlier_from_body: Array, cov_since: Array
) -> tuple[Array, Array]:
    """map_from_earlier and its covariance, map axes: the other way round than `chained`, with the covariance of the way since as there."""
    map_from_earlier = map_from_body @ se3_inverse(earlier_from_body)
    turn, lever = np.kron(np.eye(2), map_from_earlier[:3, :3]), map_from_earlier[:3, 3] - map_from_body[:3, 3]
    return map_from_earlier, moved(covariance, lever) + turn @ moved(cov_since, -earlier_from_body[:3, 3]) @ turn.T


def difference(measured: Array, predicted: Array) -> Array:
    """(6,) rotation and position of measured against predicted, map axes."""
    return np.concatenate([so3_log(measured[:3, :3] @ predicted[:3, :3].T), measured[:3, 3] - predicted[:3, 3]])


def applied(error: Array, map_from_body: Array) -> Array:
    """`map_from_body` corrected by a `difference`."""
    return se3(so3_exp(error[:3]) @ map_from_body[:3, :3], map_from_body[:3, 3] + error[3:])
