"""Evaluation against evo, and against errors that are known by construction; and the command that prints it."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from typer.testing import CliRunner

from fleetmap.errors import RecordingError, SurveyError
from fleetmap.geometry import align_points, interpolate_se3, rotation_angle_rad, se3, se3_exp, se3_inverse, so3_exp
from fleetmap.recordings.tum import format_stamp, write_tum
from fleetmap.sensors.samples import Trajectory
from mapserver.cli import app
from mapserver.evaluation.trajectory_error import absolute_trajectory_error, paired, truth_from_estimate
from mapserver.plugins.trajectory_errors.errors import (
    StampedCovariances,
    at_first_stamp,
    best_clock_shift,
    consistency,
    drift,
    read_covariances,
    summary,
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


def test_a_straight_drive_does_not_leave_the_turn_about_it_open() -> None:
    rng = np.random.default_rng(5)
    places = [se3(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(60)]
    truth = Trajectory(np.arange(60) * 50_000_000, np.array(places))
    noisy = np.array([t @ se3_exp(rng.normal(0.0, 0.002, 6)) for t in truth.frame_from_body])
    estimate_from_truth = se3_exp(np.array([0.4, -1.0, 2.0, 5.0, -7.0, 1.0]))
    found = truth_from_estimate(Trajectory(truth.stamps_ns, estimate_from_truth @ noisy), truth) @ estimate_from_truth
    by_positions = align_points(truth.positions_m, noisy[:, :3, 3])[0]
    assert rotation_angle_rad(found[:3, :3]) < 0.002
    assert rotation_angle_rad(by_positions[:3, :3]) > 0.02, "positions alone would do"


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
    for name, value in {"rmse": result.rmse_m, "max": result.max_m}.items():
        assert value == pytest.approx(wanted[name], rel=1e-9)
    np.testing.assert_allclose(result.errors_m, ape.error, atol=1e-9)
    assert result.scale == (pytest.approx(1.07, rel=1e-2) if with_scale else 1.0)
    assert (result.matched, result.evaluated_share) == (400, 1.0)


def test_relative_error_agrees_with_evo() -> None:
    truth = _truth()
    estimate = _estimate(truth)
    found = summary(estimate, truth)
    relations = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad
    for relation, name in zip(relations, ("rpe_rmse_m", "rpe_rmse_rad"), strict=True):
        rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((_path(truth), _path(estimate)))
        assert found[name] == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


def test_the_scale_has_a_sigma_and_the_worst_step_a_place() -> None:
    truth, scales, moved = _truth(), [], _truth().frame_from_body
    for seed in range(20):
        moved = truth.frame_from_body.copy()
        moved[:, :3, 3] += np.random.default_rng(seed).normal(0.0, 0.02, (400, 3))
        found = summary(Trajectory(truth.stamps_ns, moved), truth)
        scales.append((found["scale"], found["scale_sigma"]))
    assert 0.5 < np.median(scales, axis=0)[1] / np.std(scales, axis=0)[0] < 2.0
    moved[150:, 0, 3] += 0.4
    found = summary(Trajectory(truth.stamps_ns, moved), truth)
    step = [found[f"worst_step_{name}"] for name in ("from_s", "to_s", "off_m")]
    np.testing.assert_allclose(step, [149 * 0.05, 150 * 0.05, 0.4], atol=0.1)


def test_a_truth_on_another_clock_is_noticed() -> None:
    """The shift is found again, and what the ATE would be without it; a truth on the same clock gives none."""
    truth, estimate = _truth(), _estimate(_truth())
    late = Trajectory(truth.stamps_ns + 17_000_000, truth.frame_from_body)
    shifted, same = best_clock_shift(estimate, late), best_clock_shift(estimate, truth)
    assert shifted[0] - same[0] == pytest.approx(0.017, abs=5e-4)
    assert same[0] == pytest.approx(0.0, abs=3e-3)  # noise of 2 cm at 2 m/s
    assert shifted[1] == pytest.approx(same[1], rel=0.03)
    assert shifted[1] < 0.98 * absolute_trajectory_error(estimate, late).rmse_m
    assert best_clock_shift(_estimate(_truth(2)), _truth(2)) is None


def test_alignments_are_the_ones_that_were_put_in() -> None:
    """By all stamps, by the first one, and by none."""
    truth = _truth()
    estimate_from_truth = se3_exp(np.array([0.1, 2.0, -0.3, 1.0, 2.0, 3.0]))
    exact = Trajectory(truth.stamps_ns, estimate_from_truth @ truth.frame_from_body)
    result = absolute_trajectory_error(exact, truth)
    np.testing.assert_allclose(result.frame_from_estimate, se3_inverse(estimate_from_truth), atol=1e-9)
    assert result.max_m < 1e-9
    later = at_first_stamp(Trajectory(exact.stamps_ns[4:], exact.frame_from_body[4:]), truth)
    np.testing.assert_allclose(later.frame_from_body, truth.frame_from_body[4:], atol=1e-9)
    shifted = truth.frame_from_body @ se3_exp(np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]))
    shifted[:, 0, 3] += 0.25
    found = summary(Trajectory(truth.stamps_ns, shifted), truth)
    assert found["unaligned_median_m"] == pytest.approx(0.25) == found["unaligned_max_m"]
    assert found["unaligned_median_rad"] == pytest.approx(0.05)


def test_stamps_between_those_of_the_truth_are_interpolated() -> None:
    truth = _truth()
    between = [interpolate_se3(*truth.frame_from_body[k : k + 2], 0.3) for k in range(len(truth) - 1)]
    found = summary(Trajectory(truth.stamps_ns[:-1] + 15_000_000, np.array(between)), truth)
    assert found["matched"] == len(truth) - 1
    assert found["unaligned_max_m"] < 1e-9
    assert found["unaligned_median_rad"] < 1e-7


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
    for pair in ((other_clock, truth), (_truth(8), _truth(8))):
        assert drift(*pair)["drift_translation_share"] is None


@pytest.mark.parametrize(
    ("step_m", "shortest_m", "longest_m", "segments"), [(0.5, 100.0, 200.0, 40 + 20), (0.125, 1.0, 50.0, 2890)]
)
def test_drift_of_a_wrong_scale_on_a_straight_road(
    step_m: float, shortest_m: float, longest_m: float, segments: int
) -> None:
    """KITTI's lengths, and shorter ones on a road of 75 m. Steps are exact in binary, so that no length is met but for rounding."""
    frame_from_body = np.tile(np.eye(4), (600, 1, 1))
    frame_from_body[:, 0, 3] = np.arange(600) * step_m
    truth = Trajectory(np.arange(600, dtype=np.int64) * 10**8, frame_from_body)
    long = frame_from_body.copy()
    long[:, :3, 3] *= 1.02
    found = drift(Trajectory(truth.stamps_ns, long), truth)
    assert found["drift_translation_share"] == pytest.approx(0.02, rel=0.05)
    assert found["drift_rotation_radpm"] == pytest.approx(0.0, abs=1e-9)
    assert (found["drift_shortest_m"], found["drift_longest_m"]) == (shortest_m, longest_m)
    assert found["drift_segments"] == segments


COUNT = 3000


def csv_lines(given: StampedCovariances) -> list[str]:
    rows, columns = np.triu_indices(6)
    lines = ["# timestamp_s, c00, ..."]
    for stamp_ns, covariance in zip(given.stamps_ns.tolist(), given.covs_rot_trans, strict=True):
        lines.append(", ".join([format_stamp(stamp_ns), *(f"{value:.9g}" for value in covariance[rows, columns])]))
    return lines


def drawn(scale: float = 1.0) -> tuple[Trajectory, StampedCovariances, Trajectory]:
    """Estimate, covariances and truth; errors are `scale` times as large as the covariances say."""
    rng = np.random.default_rng(5)
    stamps = 10**18 + 50_000_000 * np.arange(COUNT, dtype=np.int64)
    true, mine, covs = [], [], []
    for k in range(COUNT):
        root = 0.02 * rng.normal(size=(6, 6)) + 0.03 * np.eye(6)
        error = scale * root @ rng.normal(size=6)
        rotation, place = so3_exp(rng.normal(size=3)), np.array([0.1 * k, np.sin(0.1 * k), 0.0])
        true.append(se3(rotation, place))
        mine.append(se3(so3_exp(-error[:3]) @ rotation, place - error[3:]))
        covs.append(root @ root.T)
    every = StampedCovariances(stamps, np.array(covs))
    return Trajectory(stamps, np.array(mine)), every, Trajectory(stamps, np.array(true))


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_nees_is_the_squared_ratio_of_error_and_promise(scale: float) -> None:
    found = consistency(*drawn(scale))
    assert found["nees_stamps"] == COUNT
    for name in ("nees_position", "nees_rotation", "nees"):
        assert found[name] == pytest.approx(scale**2, rel=0.06)
    for name in ("nees_inside_share", "nees_position_inside_share"):
        assert found[name] == pytest.approx(0.95 if scale == 1.0 else 0.35, abs=0.015 if scale == 1.0 else 0.2)


def test_stamps_without_a_covariance_are_left_out() -> None:
    estimate, covariances, truth = drawn()
    some = StampedCovariances(covariances.stamps_ns[::3], covariances.covs_rot_trans[::3])
    assert consistency(estimate, some, truth)["nees_stamps"] == COUNT / 3
    with pytest.raises(SurveyError, match="nanosecond"):
        consistency(estimate, StampedCovariances(some.stamps_ns + 1, some.covs_rot_trans), truth)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda line: line.replace(",", ", x", 1), "not all numbers"),
        (lambda line: line.rsplit(",", 1)[0], "20 numbers"),
        (lambda line: line.split(",")[0] + ", -1" + ", 0" * 20, "positive definite"),
        (lambda line: line + "\n" + line, "does not rise"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, change: Callable[[str], str], says: str) -> None:
    line = csv_lines(StampedCovariances(np.array([5], np.int64), np.eye(6)[None]))[1]
    (tmp_path / "c.csv").write_text(change(line))
    with pytest.raises(RecordingError, match=rf"c.csv.*line \d.*{says}"):
        read_covariances(tmp_path / "c.csv")


def test_the_command_prints_it(tmp_path: Path) -> None:
    estimate, covariances, truth = drawn()
    names = ("e.tum", "t.tum", "c.csv")
    write_tum(tmp_path / "e.tum", estimate)
    write_tum(tmp_path / "t.tum", truth)
    (tmp_path / "c.csv").write_text("\n".join(csv_lines(covariances)))
    again = read_covariances(tmp_path / "c.csv").covs_rot_trans
    np.testing.assert_allclose(again, covariances.covs_rot_trans, rtol=1e-7, atol=1e-11)
    e, t, c = (str(tmp_path / name) for name in names)
    given = ["evaluate", e, "--ground-truth", t, "--covariances", c, "--frames", str(2 * COUNT), "--json"]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    found = json.loads(result.output)
    assert found["nees"] == pytest.approx(consistency(estimate, covariances, truth)["nees"], rel=1e-4)
    assert found["evaluated_share"] == 0.5
    assert found["drift_shortest_m"] == 100.0
