"""Choice of the robots that try a version first, and what their failures prove."""

import numpy as np
import pytest
from scipy import integrate, stats

from mapserver.fleet_statistics import canary_decision
from mapserver.fleet_statistics.kpis import Counters, rate

DAY_MS = 57_600_000
SETTINGS = canary_decision.CanarySettings()


def counts(failures: int, days: float) -> Counters:
    return Counters(failures=failures, driving_ms=round(days * DAY_MS))


def test_robots_are_chosen_as_if_by_lot_and_always_the_same() -> None:
    robots = [f"robot-{n}" for n in range(20_000)]
    numbers = np.array([canary_decision.number_of("lab", 3, robot) for robot in robots])
    assert stats.kstest(numbers, "uniform").pvalue > 0.01
    other = np.array([canary_decision.number_of("lab", 4, robot) for robot in robots])
    assert abs(np.corrcoef(numbers, other)[0, 1]) < 0.03
    assert abs(np.mean(numbers < canary_decision.threshold_for(0.05, "lab", 3, robots)) - 0.05) < 0.005
    for version in range(20):  # of a small fleet at least one takes part
        few = robots[:6]
        threshold = canary_decision.threshold_for(0.05, "lab", version, few)
        assert sum(canary_decision.number_of("lab", version, robot) < threshold for robot in few) >= 1
    assert canary_decision.threshold_for(0.05, "lab", 3, []) == 0.05


def test_the_posterior_is_the_integral_of_its_definition() -> None:
    ours, theirs = rate(2, 3.0), rate(9, 60.0)

    def inside(other_rate: float) -> float:
        limit = 1.5 * other_rate + 0.5
        return float(stats.gamma.cdf(limit, 2.5, scale=1 / 3.0) * stats.gamma.pdf(other_rate, 9.5, scale=1 / 60.0))

    assert canary_decision.within_margin(ours, theirs, 1.5, 0.5) == pytest.approx(
        integrate.quad(inside, 0, 2)[0], abs=2e-3
    )


def test_a_harmless_version_is_rarely_taken_back_however_often_it_is_looked_at() -> None:
    """At the very edge of the margin: the e-value exceeds 1/alpha in at most a share alpha of the runs."""
    rng = np.random.default_rng(4)
    alarms = 0
    runs, looks = 250, 60
    for _ in range(runs):
        ours, theirs = np.cumsum(rng.poisson(0.1 * 1.5 * 0.6, looks)), np.cumsum(rng.poisson(2.0 * 0.6, looks))
        pairs = enumerate(zip(ours, theirs, strict=True), start=1)
        evidence = [
            canary_decision.evidence_of_harm(rate(int(a), 0.1 * n), rate(int(b), 2.0 * n), 1.5) for n, (a, b) in pairs
        ]
        alarms += max(evidence) >= 1 / canary_decision.ALPHA
    assert alarms / runs <= canary_decision.ALPHA * 1.5


@pytest.mark.parametrize(
    ("canary", "others", "days", "action"),
    [
        (counts(0, 0.0), counts(0, 0.0), 0.1, "wait"),
        (counts(1, 0.05), counts(0, 1.0), 0.1, "wait"),  # one failure proves nothing
        (counts(8, 0.5), counts(3, 10.0), 0.3, "roll_back"),
        (counts(0, 2.0), counts(2, 40.0), 1.0, "wait"),
        (counts(0, 4.5), counts(2, 90.0), 1.0, "promote"),
        (counts(3, 4.5), counts(60, 90.0), 1.0, "wait"),
        (counts(4, 15.0), counts(60, 300.0), 1.0, "promote"),
        (counts(3, 2.0), counts(30, 40.0), 7.5, "roll_back"),  # not proven in time
    ],
)
def test_decisions(canary: Counters, others: Counters, days: float, action: str) -> None:
    finding = canary_decision.judge_canary(canary, others, days, SETTINGS)
    assert finding.action == action, finding.reason
    assert "robot-day" in finding.reason


def test_everything_that_speaks_against_a_map_counts() -> None:
    for name in ("failures", "suspected", "docks_wrong", "blind_seen"):
        bad = Counters(driving_ms=DAY_MS, **{name: 9})
        assert canary_decision.judge_canary(bad, counts(3, 20.0), 0.3, SETTINGS).action == "roll_back", name
