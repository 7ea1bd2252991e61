"""Canaries: the choice of the first robots for a version, and the test of their failures against the others'. Pure.

Two tests use the same counts. Harm: a sequential test, by an e-value, of whether the canary's rate exceeds the margin. Proof: the
posterior probability that the rate is within the margin.
"""

import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np
import scipy

from fleetmap.config import Positive, Section
from mapserver.fleet_statistics.kpis import Counters, Rate, driven_words, format_rate, rate

Probability = Annotated[float, msgspec.Meta(gt=0, lt=1)]
Action = Literal["wait", "promote", "roll_back"]
DAY_NS = 86_400_000_000_000
ALPHA = 0.01  # probability that a version within margin_ratio is rolled back, over all repeated tests
_CONFIDENCE = 0.95  # of being within the margin, for promotion; below its complement a version may be rolled back

_WORSE_BY = np.geomspace(1.25, 50.0, 16)  # how much worse than the margin the alternatives are
_QUANTILES = (np.arange(400) + 0.5) / 400


class CanarySettings(Section, frozen=True):
    """Choice and decision of a canary. The margin: margin_ratio times the others' rate plus margin_per_robot_day.

    share: of the robots, if a command gives none. builds: versions of nights and of robots' drives begin as canaries.
    """

    share: Probability = 0.05
    margin_ratio: Annotated[float, msgspec.Meta(ge=1)] = 1.5
    margin_per_robot_day: Annotated[float, msgspec.Meta(ge=0)] = 0.5
    min_robot_days: Positive = 3.0
    max_days: Positive = 7.0
    builds: bool = False


@dataclass(frozen=True, slots=True)
class CanaryFinding:
    """Result of the counts. evidence: against the canary, harm from 1/alpha on; within_margin: probability of being within the margin."""

    action: Action
    reason: str
    canary: Rate
    others: Rate
    evidence: float
    within_margin: float


def number_of(site: str, version: int, robot: str) -> float:
    """Return a robot's number in [0, 1) for a canary: constant for one version, independent between versions."""
    digest = hashlib.sha256(f"{site}/{version}/{robot}".encode()).digest()
    return int.from_bytes(digest[:6], "big") / float(1 << 48)


def threshold_for(share: float, site: str, version: int, robots: Iterable[str]) -> float:
    """Return the threshold below which robots take part: `share`, or the smallest that includes one of `robots`."""
    numbers = [number_of(site, version, robot) for robot in robots]
    return max(share, math.nextafter(min(numbers), 1.0)) if numbers else share


def judge_canary(canary: Counters, others: Counters, age_days: float, settings: CanarySettings) -> CanaryFinding:
    """Decide whether to wait, promote or roll back, by the counts of both arms since the canary began."""
    ours, theirs = rate(canary.events, canary.robot_days), rate(others.events, others.robot_days)
    evidence = evidence_of_harm(ours, theirs, settings.margin_ratio)
    within = within_margin(ours, theirs, settings.margin_ratio, settings.margin_per_robot_day)
    action: Action
    if evidence >= 1 / ALPHA and 1 - within >= _CONFIDENCE:
        action, why = "roll_back", f"it fails more often than the margin allows (evidence {evidence:.0f} to 1)"
    elif ours.robot_days >= settings.min_robot_days and within >= _CONFIDENCE:
        action, why = "promote", f"its rate is within the margin with {within:.1%}"
    elif age_days >= settings.max_days:
        why = f"after {age_days:.1f} days it is still not shown to be within the margin ({within:.1%})"
        action = "roll_back"
    elif ours.robot_days <= 0 or theirs.robot_days <= 0:
        missing = "it" if ours.robot_days <= 0 else "the version before"
        action, why = "wait", f"no decision before robots drive with {missing}"
    else:
        why = f"too early to decide: within the margin with {within:.1%}, evidence of harm {evidence:.2g} to 1"
        action = "wait"
    allowed = f"{settings.margin_ratio:g} times the rate without it, plus {settings.margin_per_robot_day:g} failures per robot-day"
    reason = f"{why}. With it: {_rate_text(ours)}; without: {_rate_text(theirs)}. The limit is {allowed}"
    return CanaryFinding(action, reason, ours, theirs, evidence, within)


def evidence_of_harm(canary: Rate, others: Rate, margin_ratio: float) -> float:
    """Return the e-value against "the canary's rate is at most margin_ratio times the others'"; 1 without driving.

    A mixture of binomial likelihood ratios, given the number of all failures. An e-value reaches 1/alpha at any time for at most a share
    alpha of harmless canaries, however often it is tested (Ville's inequality), as long as the arms' shares of driving stay constant.

    Source: Ville 1939; Wald 1945, sequential tests of statistical hypotheses, for the mixture of likelihood ratios.
    """
    if canary.robot_days <= 0 or others.robot_days <= 0:
        return 1.0
    odds = margin_ratio * canary.robot_days / others.robot_days
    expected, alternative = odds / (1 + odds), odds * _WORSE_BY / (1 + odds * _WORSE_BY)
    ours, theirs = np.log(alternative / expected), np.log((1 - alternative) / (1 - expected))
    log_ratio = canary.events * ours + others.events * theirs
    return float(np.mean(np.exp(np.minimum(log_ratio, 600.0))))


def within_margin(canary: Rate, others: Rate, margin_ratio: float, margin_per_robot_day: float) -> float:
    """Return the posterior probability that the canary's rate is within the margin; 0.5 without driving.

    Source: Jeffreys 1946, for the prior of a Poisson rate: Gamma(n + 1/2).
    """
    if canary.robot_days <= 0 or others.robot_days <= 0:
        return 0.5
    other_rates = scipy.special.gammaincinv(others.events + 0.5, _QUANTILES) / others.robot_days
    limits = margin_ratio * other_rates + margin_per_robot_day
    return float(np.mean(scipy.special.gammainc(canary.events + 0.5, canary.robot_days * limits)))


def _rate_text(found: Rate) -> str:
    count = f"{found.events or 'no'} failure{'' if found.events == 1 else 's'}"
    if found.robot_days <= 0:
        return f"{count} and nothing driven"
    per_day = f", {format_rate(found)} per robot-day" if found.low is not None else ", too little for a rate"
    return f"{count} in {driven_words(found.robot_days)}{per_day}"
