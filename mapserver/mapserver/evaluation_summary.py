"""All errors of one trajectory in one table. Pure."""

import numpy as np

from fleetmap.samples import Trajectory
from mapserver.evaluation import absolute_trajectory_error, kitti_drift, relative_trajectory_error, unaligned_errors


def summary(estimate: Trajectory, truth: Trajectory) -> dict[str, float | int | None]:
    """Errors by name; raises SurveyError where too few stamps of the estimate have a truth.

    ate_*: after a rigid alignment; ate_sim3_rmse_m and scale: after one with scale; unaligned_*: as they are;
    rpe_*: of the motion between stamps that follow each other; drift_*: KITTI's, None for paths below 100 m.
    """
    rigid = absolute_trajectory_error(estimate, truth)
    similarity = absolute_trajectory_error(estimate, truth, with_scale=True)
    relative = relative_trajectory_error(estimate, truth)
    drift = kitti_drift(estimate, truth)
    _, errors_m, errors_rad = unaligned_errors(estimate, truth)
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
        "unaligned_median_m": float(np.median(errors_m)),
        "unaligned_max_m": float(errors_m.max()),
        "unaligned_median_rad": float(np.median(errors_rad)),
        "rpe_rmse_m": relative.rmse_m,
        "rpe_rmse_rad": relative.rmse_rad,
        "drift_translation_share": None if drift is None else drift.translation_share,
        "drift_rotation_radpm": None if drift is None else drift.rotation_radpm,
    }
