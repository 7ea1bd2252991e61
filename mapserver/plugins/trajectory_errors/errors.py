"""All errors of an estimated trajectory against the truth, at the estimate's stamps, and its covariances. Both are of the same body."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleetmap.errors import RecordingError, SurveyError
from fleetmap.geometry import Array, align_points, rotation_angle_rad, se3_inverse, so3_log, transform_points
from fleetmap.recordings.files import read_text
from fleetmap.recordings.tum import stamped_lines
from fleetmap.sensors.samples import Stamps, Trajectory
from mapserver.evaluation.trajectory_error import absolute_trajectory_error, paired, rms, scale_sigma, worst_step

_ROWS, _COLUMNS = np.triu_indices(6)


class StampedCovariances(NamedTuple):
    """stamps_ns (N,) rising, covs_rot_trans (N, 6, 6)."""

    stamps_ns: Stamps
    covs_rot_trans: Array


def read_covariances(path: Path) -> StampedCovariances:
    """Read the covariances of a trajectory: lines of a stamp and the 21 numbers of the upper triangle, rotation first.

    Raises RecordingError, naming the file and the line, for anything but 22 finite numbers of a positive definite matrix, stamps that do
    not rise, or a file that cannot be read.
    """
    stamps, covariances = [], []
    for where, _, stamp_ns, values in stamped_lines(read_text(path, "covariances as CSV are expected"), str(path)):
        if len(values) != len(_ROWS) or not np.isfinite(values).all():
            raise RecordingError(f"{where}: {len(values)} numbers after the stamp, 21 finite ones are needed")
        covariance = np.zeros((6, 6))
        covariance[_ROWS, _COLUMNS] = covariance[_COLUMNS, _ROWS] = values
        if np.linalg.eigvalsh(covariance)[0] <= 0:
            raise RecordingError(f"{where}: the covariance is not positive definite; is its order rotation first?")
        stamps.append(stamp_ns)
        covariances.append(covariance)
    return StampedCovariances(np.array(stamps, np.int64), np.array(covariances).reshape(-1, 6, 6))


_MAX_SHIFT_S = 0.05
_KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
_SHORT_LENGTHS_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # for runs too short for KITTI's
_POSITION_BOUND, _BOUND = 7.8147, 12.5916  # 0.95 of chi-square with 3 and 6 degrees of freedom
Summary = dict[str, float | int | None]


def best_clock_shift(estimate: Trajectory, truth: Trajectory) -> tuple[float, float] | None:
    """Return the delay of the truth, within 0.05 s, with the best fit, and the remaining rigid ATE.

    A diagnosis beside the ATE, never a replacement: a truth on another clock costs speed times shift. Positions
    of the truth are interpolated linearly. None if fewer than three stamps have a truth at every shift.
    """
    mine, _ = paired(estimate, truth)
    if not len(mine):
        return None
    at_s, own_s = ((stamps - truth.stamps_ns[0]) * 1e-9 for stamps in (truth.stamps_ns, mine.stamps_ns))
    inside = (own_s >= at_s[0] + _MAX_SHIFT_S) & (own_s <= at_s[-1] - _MAX_SHIFT_S)
    if inside.sum() < 3:
        return None
    own_s, positions = own_s[inside], mine.positions_m[inside]

    def rmse_m(shift_s: float) -> float:
        true = np.column_stack([np.interp(own_s + shift_s, at_s, axis) for axis in truth.positions_m.T])
        frame_from_estimate, _ = align_points(true, positions, with_scale=False)
        return rms(np.linalg.norm(transform_points(frame_from_estimate, positions) - true, axis=1))

    from scipy.optimize import minimize_scalar  # a build does not need it

    # The error has one minimum for a smooth motion, but noise adds others: a grid search gives the interval.
    grid = np.linspace(-_MAX_SHIFT_S, _MAX_SHIFT_S, 21)
    middle, step = float(grid[np.argmin([rmse_m(shift) for shift in grid])]), float(grid[1] - grid[0])
    bounds = max(middle - step, -_MAX_SHIFT_S), min(middle + step, _MAX_SHIFT_S)
    found = minimize_scalar(rmse_m, bounds=bounds, method="bounded", options={"xatol": 1e-5})
    return float(found.x), float(found.fun)


def drift(estimate: Trajectory, truth: Trajectory) -> Summary:
    """Return mean errors over segments of the path, as shares of their length and radians per metre; None for paths below a metre.

    Segments have the benchmark's own lengths if the path is long enough for one, else 1 to 50 m. Source: Geiger et al. 2012 (KITTI).
    """
    mine, true = paired(estimate, truth)
    for lengths_m, every in ((_KITTI_LENGTHS_M, 10), (_SHORT_LENGTHS_M, 1)):
        if found := _segment_errors(mine, true, lengths_m, every):
            lengths, shares, rates = np.array(found).T
            return {
                "drift_translation_share": float(shares.mean()),
                "drift_rotation_radpm": float(rates.mean()),
                "drift_shortest_m": float(lengths.min()),
                "drift_longest_m": float(lengths.max()),
                "drift_segments": len(found),
            }
    names = ("translation_share", "rotation_radpm", "shortest_m", "longest_m")
    return {**{f"drift_{name}": None for name in names}, "drift_segments": 0}


def _segment_errors(
    mine: Trajectory, true: Trajectory, lengths_m: tuple[float, ...], every: int
) -> list[tuple[float, float, float]]:
    """Return length, relative error and radians per metre of every segment of the truth starting at every `every`-th stamp."""
    steps = np.linalg.norm(np.diff(true.positions_m, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    found = []
    for start in range(0, len(mine), every):
        for length in lengths_m:
            end = int(np.searchsorted(along, along[start] + length, side="right"))
            if end < len(mine):
                error_m, error_rad = _split_errors(_motion_errors(mine, true, np.array([start]), end - start))
                found.append((length, float(error_m[0]) / length, float(error_rad[0]) / length))
    return found


def at_first_stamp(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """Return the estimate moved to the truth's frame by the first common stamp, of which there is one, as usual for odometry."""
    mine, true = paired(estimate, truth)
    frame_from_estimate = true.frame_from_body[0] @ se3_inverse(mine.frame_from_body[0])
    return Trajectory(estimate.stamps_ns, frame_from_estimate @ estimate.frame_from_body)


def consistency(estimate: Trajectory, covariances: StampedCovariances | None, truth: Trajectory) -> Summary:
    """Return mean squared normalised errors of an estimate in the truth's frame: 1 for right covariances, above if they are too small.

    nees: over all 6 degrees of freedom, nees_position and nees_rotation over 3; shares of the stamps with errors inside their own 95 %
    bound; nees_stamps: number of judged stamps. All None without covariances, which are in the truth's axes. Errors of rotation (left)
    and position are independent components. SurveyError if no stamp has estimate, covariance and truth.
    Source: Bar-Shalom, Li and Kirubarajan 2001 (NEES).
    """
    names = ("nees_position", "nees_rotation", "nees", "nees_inside_share", "nees_position_inside_share")
    if covariances is None:
        return {**dict.fromkeys(names), "nees_stamps": 0}
    known = np.isin(estimate.stamps_ns, covariances.stamps_ns)
    mine, true = paired(Trajectory(estimate.stamps_ns[known], estimate.frame_from_body[known]), truth)
    if len(mine) == 0:
        raise SurveyError(
            f"none of {len(estimate)} stamps has a covariance ({len(covariances.stamps_ns)} there) and a truth; "
            "stamps must be equal to the nanosecond"
        )
    covs = covariances.covs_rot_trans[np.searchsorted(covariances.stamps_ns, mine.stamps_ns)]
    rotations = zip(true.frame_from_body[:, :3, :3], mine.frame_from_body[:, :3, :3], strict=True)
    errors = np.hstack([[so3_log(t @ m.T) for t, m in rotations], true.positions_m - mine.positions_m])
    both = _squared(errors, covs)
    rotation, position = _squared(errors[:, :3], covs[:, :3, :3]), _squared(errors[:, 3:], covs[:, 3:, 3:])
    means = (position.mean() / 3, rotation.mean() / 3, both.mean() / 6)
    values = (*means, (both < _BOUND).mean(), (position < _POSITION_BOUND).mean())
    return {**dict(zip(names, map(float, values), strict=True)), "nees_stamps": len(mine)}


def _squared(errors: Array, covs: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covs, errors[:, :, None])[:, :, 0]))


def summary(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    frames: int | None = None,
    covariances: StampedCovariances | None = None,
    from_first: bool = False,
) -> Summary:
    """Return all errors by name; raises SurveyError if too few stamps of the estimate have a truth.

    ate_*: after a rigid alignment; ate_sim3_rmse_m and scale, with its sigma: after one with scale; worst_step_*: of `worst_step`;
    clock_shift_s, ate_at_clock_shift_m: of `best_clock_shift`; unaligned_*: without alignment, or with `from_first` after aligning the
    first stamp; rpe_*: of the motion between consecutive matched stamps (Sturm et al. 2012); drift_*: of `drift`; nees_*: of the
    unaligned errors by their covariances, of `consistency`.
    frames: expected number of estimated frames, the base of evaluated_share.
    """
    rigid = absolute_trajectory_error(estimate, truth, frames=frames)
    similarity = absolute_trajectory_error(estimate, truth, with_scale=True)
    shift_s, shifted_m = best_clock_shift(estimate, truth) or (None, None)
    mine, true = paired(estimate, truth)
    rpe_m, rpe_rad = map(rms, _split_errors(_motion_errors(mine, true, np.arange(len(mine) - 1), 1)))
    placed = at_first_stamp(estimate, truth) if from_first else estimate
    at_stamps = paired(placed, truth)[0].frame_from_body
    errors_m, errors_rad = _split_errors(se3_inverse(true.frame_from_body) @ at_stamps)
    return {
        "stamps": len(estimate),
        "matched": rigid.matched,
        "evaluated_share": rigid.evaluated_share,
        "ate_rmse_m": rigid.rmse_m,
        "ate_mean_m": float(rigid.errors_m.mean()),
        "ate_median_m": float(np.median(rigid.errors_m)),
        "ate_max_m": rigid.max_m,
        "ate_sim3_rmse_m": similarity.rmse_m,
        "scale": similarity.scale,
        "scale_sigma": scale_sigma(estimate, truth),
        **{f"worst_step_{name}": value for name, value in worst_step(estimate, truth).items()},
        "clock_shift_s": shift_s,
        "ate_at_clock_shift_m": shifted_m,
        "unaligned_median_m": float(np.median(errors_m)),
        "unaligned_max_m": float(errors_m.max()),
        "unaligned_median_rad": float(np.median(errors_rad)),
        "rpe_rmse_m": rpe_m,
        "rpe_rmse_rad": rpe_rad,
        **drift(estimate, truth),
        **consistency(placed, covariances, truth),
    }


def _motion_errors(mine: Trajectory, true: Trajectory, starts: Stamps, step: int) -> Array:
    """Return (S, 4, 4) true motion inverse times estimated motion from each start over `step` stamps."""
    moved = [se3_inverse(t.frame_from_body[starts]) @ t.frame_from_body[starts + step] for t in (true, mine)]
    return np.asarray(se3_inverse(moved[0]) @ moved[1])


def _split_errors(true_from_estimated: Array) -> tuple[Array, Array]:
    """Return metres and radians (S,) of errors (S, 4, 4)."""
    turns = [rotation_angle_rad(error[:3, :3]) for error in true_from_estimated]
    return np.linalg.norm(true_from_estimated[:, :3, 3], axis=1), np.array(turns)
