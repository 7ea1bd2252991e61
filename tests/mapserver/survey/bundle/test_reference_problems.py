"""Bundle adjustment in the large: derivatives, bad files, Ladybug-49 from two starts; tests/benchmarks compares with gtsam."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.errors import SurveyError
from fleetmap.geometry import so3_exp
from mapserver.survey.bundle.settings import BundleSettings
from support.problems import bal_kernels
from support.problems.bal import optimize_bal, parse_bal
from support.recordings.realdata import real_data

THOROUGH = BundleSettings(max_iterations=60, relative_cost_tolerance=1e-7)


def test_derivatives_are_those_of_differences() -> None:
    rng = np.random.default_rng(1)
    rot, shift, point = so3_exp(rng.normal(size=3)), np.array([0.1, -0.2, -6.0]), rng.normal(size=3)
    lens, pixel = np.array([500.0, -0.1, 0.05]), np.array([20.0, -30.0])

    def residual(step: np.ndarray) -> np.ndarray:
        out = np.empty(2)
        bal_kernels._derive(
            so3_exp(step[:3]) @ rot, shift + step[3:6], lens + step[6:9], point + step[9:], pixel,
            np.empty((2, 9)), np.empty((2, 3)), out,
        )  # fmt: skip
        return out

    by_camera, by_point = np.empty((2, 9)), np.empty((2, 3))
    bal_kernels._derive(rot, shift, lens, point, pixel, by_camera, by_point, np.empty(2))
    numeric = np.array([(residual(s) - residual(-s)) / 2e-6 for s in 1e-6 * np.eye(12)]).T
    np.testing.assert_allclose(np.hstack([by_camera, by_point]), numeric, rtol=1e-5, atol=1e-4)


def test_ladybug_ends_at_one_cost_from_two_starts() -> None:
    problem = parse_bal((real_data("pose_graphs") / "problem-49-7776-pre.txt").read_text())
    first = optimize_bal(problem, THOROUGH)
    rng = np.random.default_rng(3)
    shaken = replace(problem.start, points_map=problem.start.points_map + 0.02 * rng.normal(size=(7776, 3)))
    second = optimize_bal(replace(problem, start=shaken), THOROUGH)
    assert (np.diff(first.costs) <= 0).all()
    assert second.costs[0] != first.costs[0]
    assert second.costs[-1] == pytest.approx(first.costs[-1], rel=1e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [("1 1", "three counts"), ("1 1 1 0 0 1", "make 19 numbers"), ("a b c", "numbers alone"),
     ("1 1 1 0 5 1 1 " + "1 " * 12, "beyond 1 and 1")],
)  # fmt: skip
def test_bad_files_are_refused(text: str, words: str) -> None:
    with pytest.raises(SurveyError, match=words):
        parse_bal(text)
