"""All errors of one trajectory in one table. Pure."""

from dataclasses import astuple, dataclass

import numpy as np

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, se3_inverse, so3_log
from fleetmap.recordings.tum import StampedCovariances
from fleetmap.sensors.samples import Trajectory
from mapserver.evaluation.trajectory_error import (
    absolute_trajectory_error,
    best_clock_shift,
    drift,
    paired,
    relative_trajectory_error,
    unaligned_errors,
)

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


def consistency(estimate: Trajectory, covariances: StampedCovariances, truth: Trajectory) -> Consistency:
    """The normalised errors of an estimate that is in the truth's frame; covariances are in that frame's axes.

    Errors of rotation (on the left) and position are taken apart from each other. SurveyError where no stamp has estimate,
    covariance and truth. Source: Bar-Shalom, Li and Kirubarajan 2001 (NEES).
    """
    known = np.isin(estimate.stamps_ns, covariances.stamps_ns)
    mine, true = paired(Trajectory(estimate.stamps_ns[known], estimate.frame_from_body[known]), truth)
    if len(mine) == 0:
        raise SurveyError(
            f"none of {len(estimate)} stamps has a covariance ({len(covariances.stamps_ns)} there) and a truth; "
            "stamps must be equal to the nanosecond"
        )
    covs = covariances.covs_rot_trans[np.searchsorted(covariances.stamps_ns, mine.stamps_ns)]
    both_rotations = zip(true.frame_from_body[:, :3, :3], mine.frame_from_body[:, :3, :3], strict=True)
    turned = np.array([so3_log(t @ m.T) for t, m in both_rotations])
    errors = np.hstack([turned, true.positions_m - mine.positions_m])
    both = _squared(errors, covs)
    rotation, position = _squared(errors[:, :3], covs[:, :3, :3]), _squared(errors[:, 3:], covs[:, 3:, 3:])
    means = float(position.mean() / 3), float(rotation.mean() / 3), float(both.mean() / 6)
    return Consistency(*means, float((both < _BOUND).mean()), float((position < _POSITION_BOUND).mean()), len(mine))


def _squared(errors: Array, covs: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covs, errors[:, :, None])[:, :, 0]))


Summary = dict[str, float | int | None]


def summary(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    frames: int | None = None,
    covariances: StampedCovariances | None = None,
    from_first: bool = False,
) -> Summary:
    """Errors by name; raises SurveyError where too few stamps of the estimate have a truth.

    ate_*: after a rigid alignment; ate_sim3_rmse_m and scale: after one with scale; clock_shift_s: how much later the truth would
    have to be read to fit best, and ate_at_clock_shift_m what the ATE would be then; unaligned_*: as they are, or with
    `from_first` after placing the first stamp on the truth; rpe_*: of the motion between stamps that follow each other;
    drift_*: KITTI's, over drift_shortest_m to drift_longest_m, None for paths below a metre; nees_*: of the unaligned errors by
    their covariances, None without. frames: how many should have had an estimate, the base of evaluated_share.
    """
    rigid = absolute_trajectory_error(estimate, truth, frames=frames)
    similarity = absolute_trajectory_error(estimate, truth, with_scale=True)
    shift = best_clock_shift(estimate, truth)
    relative = relative_trajectory_error(estimate, truth)
    placed = at_first_stamp(estimate, truth) if from_first else estimate
    _, errors_m, errors_rad = unaligned_errors(placed, truth)
    return {
        "stamps": len(estimate),
        "matched": rigid.matched,
        "evaluated_share": rigid.evaluated_share,
        "ate_rmse_m": rigid.rmse_m,
        "ate_mean_m": rigid.mean_m,
        "ate_median_m": rigid.median_m,
        "ate_max_m": rigid.max_m,
        "ate_sim3_rmse_m": similarity.rmse_m,
        "scale": similarity.scale,
        "clock_shift_s": None if shift is None else shift.shift_s,
        "ate_at_clock_shift_m": None if shift is None else shift.rmse_m,
        "unaligned_median_m": float(np.median(errors_m)),
        "unaligned_max_m": float(errors_m.max()),
        "unaligned_median_rad": float(np.median(errors_rad)),
        "rpe_rmse_m": relative.rmse_m,
        "rpe_rmse_rad": relative.rmse_rad,
        **_drift(estimate, truth),
        **_nees(placed, truth, covariances),
    }


def _drift(estimate: Trajectory, truth: Trajectory) -> Summary:
    found = drift(estimate, truth)
    lengths: tuple[float | None, ...] = (None,) if found is None else found.lengths_m
    return {
        "drift_translation_share": None if found is None else found.translation_share,
        "drift_rotation_radpm": None if found is None else found.rotation_radpm,
        "drift_shortest_m": lengths[0],
        "drift_longest_m": lengths[-1],
        "drift_segments": 0 if found is None else found.segments,
    }


def _nees(placed: Trajectory, truth: Trajectory, covariances: StampedCovariances | None) -> Summary:
    found = None if covariances is None else consistency(placed, covariances, truth)
    keys = "nees_position", "nees_rotation", "nees", "nees_inside_share", "nees_position_inside_share", "nees_stamps"
    return dict(zip(keys, (None,) * 5 + (0,) if found is None else astuple(found), strict=True))
