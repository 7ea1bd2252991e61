"""The definition of a position failure: predicates at their limits, and the text that users read."""

import inspect
from pathlib import Path

import numpy as np
import pytest

from fleetmap import failure_definition
from fleetmap.failure_definition import is_blind, is_outside_bound, is_usable, is_wrong, radius_95_m
from fleetmap.messages import Status


def test_errors_at_their_limits() -> None:
    assert not is_wrong(0.30)
    assert is_wrong(0.301)
    assert not is_wrong(0.1, np.radians(4.99))
    assert is_wrong(0.1, np.radians(5.01))


@pytest.mark.parametrize("status", [*Status, "UNKNOWN TO THIS VERSION"])
@pytest.mark.parametrize("radius_m", [0.1, 0.30, 0.31, np.inf])
def test_a_position_is_usable_or_blind_or_neither(status: str, radius_m: float) -> None:
    close = radius_m <= 0.30
    assert is_usable(status, radius_m) == (status == "TRACKING" or (status == "DEGRADED" and close))
    assert is_blind(status, radius_m) == (status in ("LOST", "AMBIGUOUS") or (status == "DEGRADED" and not close))


def test_bounds_hold_what_they_say() -> None:
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(6, 6))
    covariance = factor @ factor.T
    errors = rng.multivariate_normal(np.zeros(3), covariance[3:, 3:], 20000)
    assert np.mean([is_outside_bound(error, covariance) for error in errors]) == pytest.approx(0.001, abs=0.001)
    round_cov = np.diag([1.0] * 3 + [0.04] * 3)
    inside = np.linalg.norm(rng.normal(0, 0.2, (20000, 3)), axis=1) < radius_95_m(round_cov)
    assert inside.mean() == pytest.approx(0.95, abs=0.01)
    assert radius_95_m(None) == np.inf


def test_users_read_the_same_definition() -> None:
    told = " ".join((inspect.getdoc(failure_definition) or "").split())
    page = " ".join(Path("docs/reports.md").read_text().split())
    for words in (
        "0.30 m or 5 degrees off for longer than 1 s",
        "for more than 2 s",
        "99.9 % bound for longer than 1 s",
        "5 s of good tracking",
    ):
        assert words in told
        assert words in page
