"""Errors of an estimated trajectory, and of a survey, against the truth, at the estimate's stamps. Both are of the same body. Pure."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fleetmap.errors import RecordingError, SurveyError
from fleetmap.geometry import Array, align_points, transform_points
from fleetmap.sensors.samples import Stamps, Trajectory

MAX_GAP_NS = 200_000_000
MIN_MATCHED = 3  # stamps with ground truth needed for an alignment
_OPEN_TURN_RAD = np.deg2rad(1.0)  # error of rotations in a motion capture system


@dataclass(frozen=True, slots=True)
class AteResult:
    """Position errors after one alignment.

    frame_from_estimate (4, 4) and scale align the estimate to the truth's frame: scale * R @ p + t. matched: number of stamps with
    a truth; evaluated_share: their share of the expected frames. stamps_ns and errors_m (matched,).
    """

    rmse_m: float
    max_m: float
    scale: float
    matched: int
    evaluated_share: float
    frame_from_estimate: Array
    stamps_ns: Stamps
    errors_m: Array


def paired(estimate: Trajectory, truth: Trajectory, max_gap_ns: int = MAX_GAP_NS) -> tuple[Trajectory, Trajectory]:
    """Return estimate and truth at those stamps of the estimate at which the truth is known.

    The truth is interpolated at constant twist; not outside it, nor inside a gap longer than `max_gap_ns`.
    """
    found = [truth.at(int(stamp), max_gap_ns) for stamp in estimate.stamps_ns]
    known = np.array([there is not None for there in found], bool)
    stamps = estimate.stamps_ns[known]
    true_frame_from_body = np.array([there for there in found if there is not None]).reshape(-1, 4, 4)
    return Trajectory(stamps, estimate.frame_from_body[known]), Trajectory(stamps, true_frame_from_body)


def absolute_trajectory_error(
    estimate: Trajectory, truth: Trajectory, *, with_scale: bool = False, frames: int | None = None
) -> AteResult:
    """Return position errors after the least-squares rigid (or similarity) alignment of all matched positions.

    frames: expected number of estimated frames (default: those estimated), the base of evaluated_share.
    Raises SurveyError if fewer than three stamps have a truth. Source: Sturm et al. 2012 (ATE), Umeyama 1991.
    """
    mine, true = paired(estimate, truth)
    if len(mine) < MIN_MATCHED:
        raise SurveyError(
            f"{len(mine)} of {len(estimate)} estimated stamps have ground truth within {MAX_GAP_NS / 1e6:.0f} ms gaps; "
            f"at least {MIN_MATCHED} are needed: check that both are on the same clock"
        )
    frame_from_estimate, scale = align_points(true.positions_m, mine.positions_m, with_scale=with_scale)
    errors = np.linalg.norm(transform_points(frame_from_estimate, scale * mine.positions_m) - true.positions_m, axis=1)
    return AteResult(
        rmse_m=rms(errors),
        max_m=float(errors.max()),
        scale=scale,
        matched=len(mine),
        evaluated_share=len(mine) / (len(estimate) if frames is None else max(frames, 1)),
        frame_from_estimate=frame_from_estimate,
        stamps_ns=mine.stamps_ns,
        errors_m=errors,
    )


def truth_from_estimate(estimate: Trajectory, truth: Trajectory) -> Array:
    """Return (4, 4) least-squares alignment of positions; rotations are added if a straight path leaves its roll undetermined.

    Undetermined is a rotation within the positions' own errors, at the distance of the path's second width. Rotations then count as
    points 0.1 m along either side of each axis of the body.
    """
    mine, true = paired(estimate, truth)
    by_positions, _ = align_points(true.positions_m, mine.positions_m)
    error_m = rms(np.linalg.norm(transform_points(by_positions, mine.positions_m) - true.positions_m, axis=1))
    spread = np.linalg.svd(true.positions_m - true.positions_m.mean(0), compute_uv=False)
    if error_m <= _OPEN_TURN_RAD * float(spread[1]) / np.sqrt(len(true)):
        return by_positions
    beside = 0.1 * np.hstack([np.eye(3), -np.eye(3)])

    def corners(of: Trajectory) -> Array:
        return (of.positions_m[:, :, None] + of.frame_from_body[:, :3, :3] @ beside).transpose(0, 2, 1).reshape(-1, 3)

    return align_points(corners(true), corners(mine))[0]


def rms(errors: Array) -> float:
    """Return the root mean square of errors (N,)."""
    return float(np.sqrt(np.mean(errors**2)))


def scale_sigma(estimate: Trajectory, truth: Trajectory, tenths: int = 10) -> float | None:
    """Return the sigma of an alignment's scale, by leaving out each tenth in turn (Künsch 1989); None for less than ten stamps."""
    mine, true = paired(estimate, truth)
    if len(mine) < tenths:
        return None
    places, tenth = (true.positions_m, mine.positions_m), np.arange(len(mine)) * tenths // len(mine)
    scales = [align_points(*(at[tenth != out] for at in places), with_scale=True)[1] for out in range(tenths)]
    return float(np.sqrt(tenths - 1) * np.std(scales))


def worst_step(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Return the two stamps, in seconds since the first one, between which the aligned error changes most, and by how much."""
    mine, true = paired(estimate, truth)
    if len(mine) < MIN_MATCHED:
        return {}
    aligned = transform_points(align_points(true.positions_m, mine.positions_m)[0], mine.positions_m)
    off_m = np.linalg.norm(np.diff(aligned - true.positions_m, axis=0), axis=1)
    worst = int(np.argmax(off_m))
    from_s, to_s = (mine.stamps_ns[worst : worst + 2] - estimate.stamps_ns[0]) * 1e-9
    return {"from_s": float(from_s), "to_s": float(to_s), "off_m": float(off_m[worst])}


class Accuracy(NamedTuple):
    """A survey, and its worst step between keyframes, against ground truth; all None if too few stamps have both (see MIN_MATCHED)."""

    rigid: AteResult | None = None
    similarity: AteResult | None = None
    evaluated_share: float | None = None
    scale_sigma: float | None = None
    worst_step: dict[str, float] | None = None


def accuracy(estimate: Trajectory, frames: int, truth: Trajectory | None, keyframe_stamps_ns: Stamps) -> Accuracy:
    """Return errors of all estimated ones of a survey's frames with a known truth."""
    if truth is None:
        return Accuracy()
    matched = len(paired(estimate, truth)[0])
    if matched < MIN_MATCHED:
        return Accuracy(evaluated_share=matched / max(frames, 1))
    rigid = absolute_trajectory_error(estimate, truth, frames=frames)
    similarity = absolute_trajectory_error(estimate, truth, with_scale=True, frames=frames)
    is_key = np.isin(estimate.stamps_ns, keyframe_stamps_ns)
    step = worst_step(Trajectory(estimate.stamps_ns[is_key], estimate.frame_from_body[is_key]), truth)
    return Accuracy(rigid, similarity, rigid.evaluated_share, scale_sigma(estimate, truth), step)


def check_truth(what: str, stamps_ns: Stamps, truth: Trajectory | None) -> None:
    """Raise RecordingError unless enough of the stamps (F,) have a truth to align a survey to its frame."""
    if truth is None:
        raise RecordingError(f"{what} carries no ground truth; build it without --frame-from-ground-truth")
    known = sum(truth.at(int(stamp)) is not None for stamp in stamps_ns)
    if known < MIN_MATCHED:
        raise RecordingError(
            f"{what}: {known} of {len(stamps_ns)} selected frames have a ground truth, {MIN_MATCHED} are needed; "
            "select others with --frames or build without --frame-from-ground-truth"
        )
