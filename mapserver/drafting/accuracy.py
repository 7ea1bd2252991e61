"""Errors of a survey against ground truth. Pure."""

from typing import Any

import msgspec

from fleetmap.errors import RecordingError
from fleetmap.sensors.samples import Trajectory
from mapserver.evaluation.trajectory_error import AteResult, absolute_trajectory_error, paired
from mapserver.survey.survey_map import SurveyMap

MIN_MATCHED = 3  # stamps with ground truth needed for an alignment


class Accuracy(msgspec.Struct, frozen=True):
    """A survey against ground truth; all None without one, or if too few stamps have both (see MIN_MATCHED)."""

    rigid: AteResult | None = None
    similarity: AteResult | None = None
    evaluated_share: float | None = None


def estimated_trajectory(survey_map: SurveyMap) -> Trajectory:
    """Return the selected frames whose poses are measured in the map."""
    chosen = survey_map.trajectory_estimated
    return Trajectory(survey_map.trajectory.stamps_ns[chosen], survey_map.trajectory.frame_from_body[chosen])


def accuracy(survey_map: SurveyMap, truth: Trajectory | None) -> Accuracy:
    """Return errors of all estimated frames with a known truth; interpolated poses are left out and counted."""
    if truth is None:
        return Accuracy()
    estimate, frames = estimated_trajectory(survey_map), len(survey_map.trajectory)
    matched = len(paired(estimate, truth)[0])
    if matched < MIN_MATCHED:
        return Accuracy(evaluated_share=matched / max(frames, 1))
    rigid = absolute_trajectory_error(estimate, truth, frames=frames)
    similarity = absolute_trajectory_error(estimate, truth, with_scale=True, frames=frames)
    return Accuracy(rigid, similarity, rigid.evaluated_share)


def check_truth(what: str, stamps_ns: Any, truth: Trajectory | None) -> None:
    """Raise RecordingError unless enough of the stamps (F,) have a truth to align a survey to its frame."""
    if truth is None:
        raise RecordingError(f"{what} carries no ground truth; build it without --frame-from-ground-truth")
    known = sum(truth.at(int(stamp)) is not None for stamp in stamps_ns)
    if known < MIN_MATCHED:
        raise RecordingError(
            f"{what}: {known} of {len(stamps_ns)} selected frames have a ground truth, {MIN_MATCHED} are needed; "
            "select others with --frames or build without --frame-from-ground-truth"
        )
