"""Evaluation against evo, and against errors that are known by construction."""

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, interpolate_se3, se3_exp, se3_inverse
from fleetmap.sensors.samples import Trajectory
from mapserver.evaluation.trajectory_error import (
    absolute_trajectory_error,
    best_clock_shift,
    drift,
    kitti_drift,
    paired,
    relative_trajectory_error,
    unaligned_errors,
)


def _truth(count: int = 400, step_m: float = 0.1) -> Trajectory:
    """A winding path, 20 Hz."""
    rng = np.random.default_rng(3)
    turn = np.cumsum(rng.normal(0.0, 0.01, (count, 3)), axis=0)
    frame_from_body = [np.eye(4)]
    for k in range(count - 1):
        frame_from_body.append(frame_from_body[-1] @ se3_exp(np.concatenate([turn[k] * 0.1, [step_m, 0.01, 0.0]])))
    return Trajectory(np.arange(count, dtype=np.int64) * 50_000_000 + 10**18, np.array(frame_from_body))


def _estimate(truth: Trajectory, scale: float = 1.0) -> Trajectory:
    """The truth in another frame, with noise and another scale."""
    rng = np.random.default_rng(4)
    estimate_from_truth = se3_exp(np.array([0.4, -1.0, 2.0, 5.0, -7.0, 1.0]))
    noisy = np.array([estimate_from_truth @ t @ se3_exp(rng.normal(0.0, 0.02, 6)) for t in truth.frame_from_body])
    noisy[:, :3, 3] /= scale
    return Trajectory(truth.stamps_ns, noisy)


def _path(trajectory: Trajectory) -> PosePath3D:
    return PosePath3D(poses_se3=list(trajectory.frame_from_body))


@pytest.mark.parametrize("with_scale", [False, True])
def test_ate_agrees_with_evo(with_scale: bool) -> None:
    truth = _truth()
    estimate = _estimate(truth, scale=1.07)
    result = absolute_trajectory_error(estimate, truth, with_scale=with_scale)
    reference, theirs = _path(truth), _path(estimate)
    theirs.align(reference, correct_scale=with_scale)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, theirs))
    wanted = ape.get_all_statistics()
    found = {"rmse": result.rmse_m, "mean": result.mean_m, "median": result.median_m, "max": result.max_m}
    for name, value in found.items():
        assert value == pytest.approx(wanted[name], rel=1e-9)
    np.testing.assert_allclose(result.errors_m, ape.error, atol=1e-9)
    assert result.scale == (pytest.approx(1.07, rel=1e-2) if with_scale else 1.0)
    assert (result.matched, result.evaluated_share) == (400, 1.0)


def test_a_truth_on_another_clock_is_noticed() -> None:
    """The shift is found again, and what the ATE would be without it; a truth on the same clock gives none."""
    truth, estimate = _truth(), _estimate(_truth())
    late = Trajectory(truth.stamps_ns + 17_000_000, truth.frame_from_body)
    shifted, same = best_clock_shift(estimate, late), best_clock_shift(estimate, truth)
    assert shifted is not None
    assert same is not None
    assert shifted.shift_s - same.shift_s == pytest.approx(0.017, abs=5e-4)
    assert same.shift_s == pytest.approx(0.0, abs=3e-3)  # noise of 2 cm at 2 m/s
    assert shifted.rmse_m == pytest.approx(same.rmse_m, rel=0.03)
    assert shifted.rmse_m < 0.98 * absolute_trajectory_error(estimate, late).rmse_m
    assert best_clock_shift(_estimate(_truth(2)), _truth(2)) is None


@pytest.mark.parametrize("step", [1, 10])
def test_relative_error_agrees_with_evo(step: int) -> None:
    truth = _truth()
    estimate = _estimate(truth)
    result = relative_trajectory_error(estimate, truth, step=step)
    for relation, mine in (
        (metrics.PoseRelation.translation_part, result.rmse_m),
        (metrics.PoseRelation.rotation_angle_rad, result.rmse_rad),
    ):
        rpe = metrics.RPE(relation, delta=step, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((_path(truth), _path(estimate)))
        assert mine == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


def test_the_alignment_is_the_one_that_was_put_in() -> None:
    truth = _truth()
    estimate_from_truth = se3_exp(np.array([0.1, 2.0, -0.3, 1.0, 2.0, 3.0]))
    exact = Trajectory(truth.stamps_ns, estimate_from_truth @ truth.frame_from_body)
    result = absolute_trajectory_error(exact, truth)
    np.testing.assert_allclose(result.frame_from_estimate, se3_inverse(estimate_from_truth), atol=1e-9)
    assert result.max_m < 1e-9


def test_stamps_between_those_of_the_truth_are_interpolated() -> None:
    truth = _truth()
    between = [interpolate_se3(*truth.frame_from_body[k : k + 2], 0.3) for k in range(len(truth) - 1)]
    estimate = Trajectory(truth.stamps_ns[:-1] + 15_000_000, np.array(between))
    stamps, errors_m, errors_rad = unaligned_errors(estimate, truth)
    assert len(stamps) == len(truth) - 1
    assert errors_m.max() < 1e-9
    assert errors_rad.max() < 1e-7


def test_unaligned_errors_are_not_aligned() -> None:
    truth = _truth()
    shifted = truth.frame_from_body @ se3_exp(np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]))
    shifted[:, 0, 3] += 0.25
    _, errors_m, errors_rad = unaligned_errors(Trajectory(truth.stamps_ns, shifted), truth)
    np.testing.assert_allclose(errors_m, 0.25, atol=1e-9)
    np.testing.assert_allclose(errors_rad, 0.05, atol=1e-9)


def test_what_has_no_truth_is_not_counted() -> None:
    truth = _truth()
    holes = np.ones(len(truth), bool)
    holes[100:120] = False
    gappy = Trajectory(truth.stamps_ns[holes], truth.frame_from_body[holes])
    late = Trajectory(truth.stamps_ns + 200 * 50_000_000, truth.frame_from_body)
    assert len(paired(truth, gappy)[0]) == 380
    assert len(paired(truth, gappy, max_gap_ns=2_000_000_000)[0]) == 400
    result = absolute_trajectory_error(truth, gappy, frames=760)
    assert (result.matched, result.evaluated_share) == (380, 0.5)
    assert absolute_trajectory_error(late, truth).matched == 200


def test_too_little_in_common_is_an_error() -> None:
    truth = _truth(10)
    other_clock = Trajectory(truth.stamps_ns - 10**18, truth.frame_from_body)
    with pytest.raises(SurveyError, match="0 of 10"):
        absolute_trajectory_error(other_clock, truth)
    with pytest.raises(SurveyError, match="too few"):
        relative_trajectory_error(truth, truth, step=10)
    assert kitti_drift(other_clock, truth) is None
    assert kitti_drift(truth, truth) is None


def _scaled(truth: Trajectory, factor: float) -> Array:
    scaled = truth.frame_from_body.copy()
    scaled[:, :3, 3] *= factor
    return scaled


def test_drift_of_a_wrong_scale_on_a_straight_road() -> None:
    frame_from_body = np.tile(np.eye(4), (600, 1, 1))
    frame_from_body[:, 0, 3] = np.arange(600) * 0.5
    truth = Trajectory(np.arange(600, dtype=np.int64) * 10**8, frame_from_body)
    drift = kitti_drift(Trajectory(truth.stamps_ns, _scaled(truth, 1.02)), truth, lengths_m=(100.0, 200.0))
    assert drift is not None
    assert drift.translation_share == pytest.approx(0.02, rel=0.02)
    assert drift.rotation_radpm < 1e-9
    assert drift.segments == 40 + 20


def test_short_runs_drift_over_short_lengths() -> None:
    frame_from_body = np.tile(np.eye(4), (400, 1, 1))
    frame_from_body[:, 0, 3] = np.arange(400) * 0.1
    truth = Trajectory(np.arange(400, dtype=np.int64) * 10**8, frame_from_body)
    found = drift(Trajectory(truth.stamps_ns, _scaled(truth, 1.03)), truth)
    assert found is not None
    assert found.lengths_m == (1.0, 2.0, 5.0, 10.0, 20.0)
    assert found.translation_share == pytest.approx(0.03, rel=0.05)
    assert drift(_truth(8), _truth(8)) is None
