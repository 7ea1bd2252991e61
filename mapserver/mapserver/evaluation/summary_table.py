"""All errors of one trajectory in one table. Pure."""

from dataclasses import astuple

import numpy as np

from fleetmap.recordings.covariances import StampedCovariances
from fleetmap.sensors.samples import Trajectory
from mapserver.evaluation.nees import at_first_stamp, consistency
from mapserver.evaluation.trajectory_error import (
    absolute_trajectory_error,
    best_clock_shift,
    drift,
    relative_trajectory_error,
    unaligned_errors,
)

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
