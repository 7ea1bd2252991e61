"""Errors of an estimated trajectory against the truth, at the estimate's stamps. Both are of the same body."""

from dataclasses import dataclass

import numpy as np

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, align_points, rotation_angle_rad, se3_inverse, transform_points
from fleetmap.sensors.samples import Stamps, Trajectory

MAX_GAP_NS = 200_000_000
_MAX_SHIFT_S = 0.05
KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SHORT_LENGTHS_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # for runs too short for KITTI's


@dataclass(frozen=True, slots=True)
class AteResult:
    """Position errors after one alignment.

    frame_from_estimate (4, 4) and scale place the estimate in the truth's frame: scale * R @ p + t. matched stamps had
    a truth; evaluated_share is their share of the frames that were asked for. stamps_ns and errors_m (matched,).
    """

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    scale: float
    matched: int
    evaluated_share: float
    frame_from_estimate: Array
    stamps_ns: Stamps
    errors_m: Array


@dataclass(frozen=True, slots=True)
class ClockShift:
    """How much later, by its own stamps, the truth has to be read to fit the estimate best, and the rigid ATE that is left then."""

    shift_s: float
    rmse_m: float


@dataclass(frozen=True, slots=True)
class RelativeResult:
    """Root mean squares of the errors of relative transforms."""

    rmse_m: float
    rmse_rad: float


@dataclass(frozen=True, slots=True)
class DriftResult:
    """Mean drift over segments, KITTI style: share of the length, and radians a metre; lengths_m of which there were any."""

    translation_share: float
    rotation_radpm: float
    segments: int
    lengths_m: tuple[float, ...]


def paired(estimate: Trajectory, truth: Trajectory, max_gap_ns: int = MAX_GAP_NS) -> tuple[Trajectory, Trajectory]:
    """Estimate and truth at those stamps of the estimate at which the truth is known.

    The truth is interpolated at constant twist; not outside it, nor inside a gap longer than `max_gap_ns`.
    """
    found = [truth.at(int(stamp), max_gap_ns) for stamp in estimate.stamps_ns]
    known = np.array([there is not None for there in found], bool)
    stamps = estimate.stamps_ns[known]
    true_frame_from_body = np.array([there for there in found if there is not None]).reshape(-1, 4, 4)
    return Trajectory(stamps, estimate.frame_from_body[known]), Trajectory(stamps, true_frame_from_body)


def absolute_trajectory_error(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    with_scale: bool = False,
    frames: int | None = None,
) -> AteResult:
    """Position errors after the least-squares rigid (or similarity) alignment of all matched positions.

    frames: how many frames should have had an estimate (default: as many as have one), the base of evaluated_share.
    Raises SurveyError where fewer than three stamps have a truth. Source: Sturm et al. 2012 (ATE), Umeyama 1991.
    """
    mine, true = paired(estimate, truth)
    if len(mine) < 3:
        raise SurveyError(
            f"{len(mine)} of {len(estimate)} estimated stamps have ground truth within {MAX_GAP_NS / 1e6:.0f} ms gaps; "
            "at least 3 are needed: check that both are on the same clock"
        )
    frame_from_estimate, scale = align_points(true.positions_m, mine.positions_m, with_scale=with_scale)
    errors = np.linalg.norm(transform_points(frame_from_estimate, scale * mine.positions_m) - true.positions_m, axis=1)
    return AteResult(
        rmse_m=_rms(errors),
        mean_m=float(errors.mean()),
        median_m=float(np.median(errors)),
        max_m=float(errors.max()),
        scale=scale,
        matched=len(mine),
        evaluated_share=len(mine) / (len(estimate) if frames is None else max(frames, 1)),
        frame_from_estimate=frame_from_estimate,
        stamps_ns=mine.stamps_ns,
        errors_m=errors,
    )


def best_clock_shift(estimate: Trajectory, truth: Trajectory) -> ClockShift | None:
    """The shift of the truth's stamps, within +- _MAX_SHIFT_S, at which the rigid ATE is smallest.

    A diagnosis beside the ATE, never in its place: a truth that was recorded by another clock costs speed times shift. Positions
    of the truth are interpolated linearly. None where fewer than three stamps have a truth at every shift.
    """
    mine, _ = paired(estimate, truth)
    origin_ns = int(truth.stamps_ns[0]) if len(truth) else 0
    at_s, own_s = (truth.stamps_ns - origin_ns) * 1e-9, (mine.stamps_ns - origin_ns) * 1e-9
    inside = (own_s >= at_s[0] + _MAX_SHIFT_S) & (own_s <= at_s[-1] - _MAX_SHIFT_S) if len(mine) else np.zeros(0, bool)
    if inside.sum() < 3:
        return None
    own_s, positions = own_s[inside], mine.positions_m[inside]

    def rmse_m(shift_s: float) -> float:
        true = np.column_stack([np.interp(own_s + shift_s, at_s, axis) for axis in truth.positions_m.T])
        frame_from_estimate, _ = align_points(true, positions, with_scale=False)
        return _rms(np.linalg.norm(transform_points(frame_from_estimate, positions) - true, axis=1))

    from scipy.optimize import minimize_scalar  # a build does not need it

    # The error has one minimum for a smooth motion, but noise makes others: the best of a grid says around which to look.
    grid = np.linspace(-_MAX_SHIFT_S, _MAX_SHIFT_S, 21)
    middle, step = float(grid[np.argmin([rmse_m(shift) for shift in grid])]), float(grid[1] - grid[0])
    bounds = max(middle - step, -_MAX_SHIFT_S), min(middle + step, _MAX_SHIFT_S)
    found = minimize_scalar(rmse_m, bounds=bounds, method="bounded", options={"xatol": 1e-5})
    return ClockShift(float(found.x), float(found.fun))


def unaligned_errors(estimate: Trajectory, truth: Trajectory) -> tuple[Stamps, Array, Array]:
    """Stamps (P,), metres and radians (P,) between estimate and truth as they are, both already in one frame."""
    mine, true = paired(estimate, truth)
    errors_m, errors_rad = _split_errors(se3_inverse(true.frame_from_body) @ mine.frame_from_body)
    return mine.stamps_ns, errors_m, errors_rad


def relative_trajectory_error(estimate: Trajectory, truth: Trajectory, *, step: int = 1) -> RelativeResult:
    """Errors of the motion over `step` matched stamps, for every start.

    Needs no alignment. Raises SurveyError where no pair of stamps has a truth. Source: Sturm et al. 2012 (RPE).
    """
    mine, true = paired(estimate, truth)
    if len(mine) <= step:
        raise SurveyError(f"{len(mine)} matched stamps are too few for relative errors over {step}; check the clocks")
    errors_m, errors_rad = _split_errors(_motion_errors(mine, true, np.arange(len(mine) - step), step))
    return RelativeResult(_rms(errors_m), _rms(errors_rad))


def kitti_drift(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    lengths_m: tuple[float, ...] = KITTI_LENGTHS_M,
    every: int = 10,
) -> DriftResult | None:
    """Mean drift over all segments of the given lengths along the truth, beginning at every `every`-th matched stamp.

    None where the path is shorter than the shortest length. Source: Geiger et al. 2012 (KITTI odometry benchmark).
    """
    mine, true = paired(estimate, truth)
    if len(mine) < 2:
        return None
    steps = np.linalg.norm(np.diff(true.positions_m, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    shares, rates, found = [], [], set()
    for start in range(0, len(mine), every):
        for length in lengths_m:
            end = int(np.searchsorted(along, along[start] + length, side="right"))
            if end == len(mine):
                continue
            error_m, error_rad = _split_errors(_motion_errors(mine, true, np.array([start]), end - start))
            shares.append(float(error_m[0]) / length)
            rates.append(float(error_rad[0]) / length)
            found.add(length)
    if not shares:
        return None
    return DriftResult(float(np.mean(shares)), float(np.mean(rates)), len(shares), tuple(sorted(found)))


def drift(estimate: Trajectory, truth: Trajectory) -> DriftResult | None:
    """KITTI's drift, over the benchmark's own lengths where the path is long enough for one, else over 1 to 50 m.

    None for paths below a metre.
    """
    return kitti_drift(estimate, truth) or kitti_drift(estimate, truth, lengths_m=SHORT_LENGTHS_M, every=1)


def _motion_errors(mine: Trajectory, true: Trajectory, starts: Stamps, step: int) -> Array:
    """(S, 4, 4) true motion inverse times estimated motion from each start over `step` stamps."""
    moved = [se3_inverse(t.frame_from_body[starts]) @ t.frame_from_body[starts + step] for t in (true, mine)]
    return np.asarray(se3_inverse(moved[0]) @ moved[1])


def _split_errors(true_from_estimated: Array) -> tuple[Array, Array]:
    """Metres and radians (S,) of errors (S, 4, 4)."""
    return (
        np.linalg.norm(true_from_estimated[:, :3, 3], axis=1),
        np.array([rotation_angle_rad(error[:3, :3]) for error in true_from_estimated]),
    )


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))
