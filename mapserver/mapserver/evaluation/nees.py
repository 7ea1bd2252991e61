"""Consistency of an estimate: errors normalised by their own covariances (NEES). Pure."""

from dataclasses import dataclass

import numpy as np

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, se3_inverse, so3_log
from fleetmap.recordings.covariances import StampedCovariances
from fleetmap.sensors.samples import Trajectory
from mapserver.evaluation.trajectory_error import MAX_GAP_NS, paired

_POSITION_BOUND, _BOUND = 7.8147, 12.5916  # 0.95 of chi-square with 3 and 6 degrees of freedom


@dataclass(frozen=True, slots=True)
class Consistency:
    """Mean squared normalised errors per degree of freedom: 1 where covariances are right, above where they are too small.

    position, rotation: of 3 degrees of freedom each; both: of all 6. inside_share: of the stamps whose error lies in their own
    95 % bound (of 6 degrees of freedom), position_inside_share: the same of the positions alone. stamps: how many were judged.
    """

    position: float
    rotation: float
    both: float
    inside_share: float
    position_inside_share: float
    stamps: int


def at_first_stamp(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """The estimate placed in the truth's frame by the first stamp that both know, as odometry is judged."""
    mine, true = paired(estimate, truth)
    if len(mine) == 0:
        raise SurveyError("no stamp of the estimate has a truth; check that both are on the same clock")
    frame_from_estimate = true.frame_from_body[0] @ se3_inverse(mine.frame_from_body[0])
    return Trajectory(estimate.stamps_ns, frame_from_estimate @ estimate.frame_from_body)


def consistency(
    estimate: Trajectory, covariances: StampedCovariances, truth: Trajectory, max_gap_ns: int = MAX_GAP_NS
) -> Consistency:
    """The normalised errors of an estimate that is in the truth's frame; covariances are in that frame's axes.

    Errors of rotation (on the left) and position are taken apart from each other. SurveyError where no stamp has estimate,
    covariance and truth. Source: Bar-Shalom, Li and Kirubarajan 2001 (NEES).
    """
    known = np.isin(estimate.stamps_ns, covariances.stamps_ns)
    mine, true = paired(Trajectory(estimate.stamps_ns[known], estimate.frame_from_body[known]), truth, max_gap_ns)
    if len(mine) == 0:
        raise SurveyError(
            f"none of {len(estimate)} stamps has a covariance ({len(covariances.stamps_ns)} there) and a truth; "
            "stamps must be equal to the nanosecond"
        )
    covs = covariances.covs_rot_trans[np.searchsorted(covariances.stamps_ns, mine.stamps_ns)]
    errors = np.array([_error(t, m) for t, m in zip(true.frame_from_body, mine.frame_from_body, strict=True)])
    both = _squared(errors, covs)
    rotation, position = _squared(errors[:, :3], covs[:, :3, :3]), _squared(errors[:, 3:], covs[:, 3:, 3:])
    means = float(position.mean() / 3), float(rotation.mean() / 3), float(both.mean() / 6)
    return Consistency(*means, float((both < _BOUND).mean()), float((position < _POSITION_BOUND).mean()), len(mine))


def _error(true: Array, mine: Array) -> Array:
    return np.concatenate([so3_log(true[:3, :3] @ mine[:3, :3].T), true[:3, 3] - mine[:3, 3]])


def _squared(errors: Array, covs: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covs, errors[:, :, None])[:, :, 0]))
