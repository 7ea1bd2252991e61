"""NEES of errors drawn from known covariances, and the command that prints it."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.errors import RecordingError, SurveyError
from fleetmap.geometry import se3, so3_exp
from fleetmap.recordings.tum import (
    StampedCovariances,
    format_stamp,
    parse_covariances,
    read_covariances,
    write_tum,
)
from fleetmap.sensors.samples import Trajectory
from mapserver.cli import app
from mapserver.evaluation.summary_table import at_first_stamp, consistency

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
    return (
        Trajectory(stamps, np.array(mine)),
        StampedCovariances(stamps, np.array(covs)),
        Trajectory(stamps, np.array(true)),
    )


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_nees_is_the_squared_ratio_of_error_and_promise(scale: float) -> None:
    found = consistency(*drawn(scale))
    assert found.stamps == COUNT
    for value in (found.position, found.rotation, found.both):
        assert value == pytest.approx(scale**2, rel=0.06)
    if scale == 1.0:
        assert found.inside_share == pytest.approx(0.95, abs=0.015)
        assert found.position_inside_share == pytest.approx(0.95, abs=0.015)
    else:
        assert found.inside_share < 0.5


def test_stamps_without_a_covariance_are_left_out() -> None:
    estimate, covariances, truth = drawn()
    some = StampedCovariances(covariances.stamps_ns[::3], covariances.covs_rot_trans[::3])
    assert consistency(estimate, some, truth).stamps == COUNT / 3
    with pytest.raises(SurveyError, match="nanosecond"):
        consistency(estimate, StampedCovariances(some.stamps_ns + 1, some.covs_rot_trans), truth)


def test_odometry_is_placed_by_its_first_stamp() -> None:
    _, _, truth = drawn()
    elsewhere = se3(so3_exp(np.array([0.1, 0.2, 2.0])), np.array([3.0, 4.0, 5.0]))
    moved = at_first_stamp(Trajectory(truth.stamps_ns[4:], elsewhere @ truth.frame_from_body[4:]), truth)
    np.testing.assert_allclose(moved.frame_from_body, truth.frame_from_body[4:], atol=1e-9)


def test_a_covariance_file_comes_back(tmp_path: Path) -> None:
    _, covariances, _ = drawn()
    (tmp_path / "c.csv").write_text("\n".join(csv_lines(covariances)))
    again = read_covariances(tmp_path / "c.csv")
    np.testing.assert_array_equal(again.stamps_ns, covariances.stamps_ns)
    np.testing.assert_allclose(again.covs_rot_trans, covariances.covs_rot_trans, rtol=1e-7, atol=1e-11)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda line: line.replace(",", ", x", 1), "not all numbers"),
        (lambda line: line.rsplit(",", 1)[0], "20 numbers"),
        (lambda line: line.split(",")[0] + ", -1" + ", 0" * 20, "positive definite"),
        (lambda line: line + "\n" + line, "does not rise"),
    ],
)
def test_bad_lines_are_named(change: object, says: str) -> None:
    one = StampedCovariances(np.array([5], np.int64), np.eye(6)[None])
    line = csv_lines(one)[1]
    assert callable(change)
    with pytest.raises(RecordingError, match=rf"line \d.*{says}"):
        parse_covariances(change(line), "c.csv")


def test_the_command_prints_it(tmp_path: Path) -> None:
    estimate, covariances, truth = drawn()
    write_tum(tmp_path / "e.tum", estimate)
    write_tum(tmp_path / "t.tum", truth)
    (tmp_path / "c.csv").write_text("\n".join(csv_lines(covariances)))
    files = [
        str(tmp_path / "e.tum"),
        "--ground-truth",
        str(tmp_path / "t.tum"),
        "--covariances",
        str(tmp_path / "c.csv"),
    ]
    result = CliRunner().invoke(app, ["evaluate", *files, "--frames", str(2 * COUNT), "--json"])
    assert result.exit_code == 0, result.output
    found: dict[str, float] = json.loads(result.output)
    assert found["nees"] == pytest.approx(consistency(estimate, covariances, truth).both, rel=1e-4)
    assert found["evaluated_share"] == 0.5
    assert found["drift_shortest_m"] == 100.0
