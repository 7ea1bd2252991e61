"""The definition of a position failure: predicates at their limits, and the text that users read."""

import inspect
from pathlib import Path

import numpy as np
import pytest

from fleetmap import failure_definition
from fleetmap.failure_definition import is_blind, is_driving, is_found, is_outside_bound, is_usable, radius_95_m
from fleetmap.messages import Status


@pytest.mark.parametrize("status", [*Status, "UNKNOWN TO THIS VERSION"])
@pytest.mark.parametrize("radius_m", [0.1, 0.30, 0.31, np.inf])
def test_a_position_is_usable_or_blind_or_neither(status: str, radius_m: float) -> None:
    close = radius_m <= 0.30
    assert is_usable(status, radius_m) == (status == "TRACKING" or (status == "DEGRADED" and close))
    assert is_blind(status, radius_m) == (status in ("LOST", "AMBIGUOUS") or (status == "DEGRADED" and not close))


def test_a_speed_that_nobody_knows_is_driving() -> None:
    assert [is_driving(speed) for speed in (None, 0.0, 0.049, 0.05, -1.0)] == [True, False, False, True, True]


def test_a_fix_finds_the_robot_only_with_a_position_to_rely_upon() -> None:
    assert is_found(True, False, "TRACKING", 0.1)
    assert is_found(False, True, "DEGRADED", 0.1)
    unusable = (True, "DEGRADED", 0.4), (True, "INITIALISING", 0.1), (False, "DEGRADED", 0.1)
    assert not any(is_found(False, *said) for said in unusable)


def test_bounds_hold_what_they_say() -> None:
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(6, 6))
    covariance = factor @ factor.T
    errors = rng.multivariate_normal(np.zeros(3), covariance[3:, 3:], 20000)
    assert np.mean([is_outside_bound(error, covariance) for error in errors]) == pytest.approx(0.001, abs=0.001)
    round_cov = np.diag([1.0] * 3 + [0.04] * 3)
    inside = np.linalg.norm(rng.normal(0, 0.2, (20000, 3)), axis=1) < radius_95_m(round_cov)
    assert inside.mean() == pytest.approx(0.95, abs=0.01)
    assert radius_95_m(-1e-12 * np.eye(6)) == np.inf
    assert radius_95_m(None) == radius_95_m(np.nan * np.eye(6)) == radius_95_m(np.diag([1.0] * 5 + [np.inf])) == np.inf


def test_users_read_the_same_definition() -> None:
    told = " ".join((inspect.getdoc(failure_definition) or "").split())
    page = " ".join(Path("docs/reports.md").read_text().split())
    for words in (
        "0.30 m or 5 degrees off for longer than 1 s",
        "for more than 2 s",
        "99.9 % bound for longer than 1 s",
        "5 s of good tracking",
        "20 s of driving or 60 s of standing since the start, or since it was last localized",
    ):
        assert words in told
        assert words in page
