"""Findings of the checks, and their limits."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple


class Verdict(StrEnum):
    """How bad a finding is, the best first. NOT_JUDGED is no OK. Only FAIL ends the command with another exit status."""

    OK = "ok"
    NOT_JUDGED = "not judged"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: its name, what was measured against which limit (in words of the unit), and what to do next.

    missing: for a check that is not judged, or whose value is not known well enough to be corrected, the motion or sensor that would make
    it observable. A check that is not judged has a value only where one was measured that may be chance.
    """

    name: str
    verdict: Verdict
    value: float | None
    limit: str
    sentence: str
    missing: str = ""


class Limits(NamedTuple):
    """Above which values a check warns and fails, and their unit in words."""

    warn_above: float
    fail_above: float
    unit: str


def judge(name: str, value: float, limits: Limits, good: str, bad: str) -> Finding:
    """A finding about a value that should be small. `good` is its sentence when it is, `bad` (with the next step) when not."""
    warn_above, fail_above, unit = limits
    verdict = Verdict.FAIL if value > fail_above else Verdict.WARN if value > warn_above else Verdict.OK
    limit = f"warn above {warn_above:g} {unit}, fail above {fail_above:g} {unit}".replace(" ,", ",").strip()
    return Finding(name, verdict, value, limit, good if verdict is Verdict.OK else bad)


def not_judged(name: str, reason: str, missing: str) -> Finding:
    """A check that this recording gives no ground for, and what it lacks."""
    return Finding(name, Verdict.NOT_JUDGED, None, "", f"not judged: {reason}; {missing}", missing)


def worst(findings: Sequence[Finding]) -> Verdict:
    """The worst verdict of all; NOT_JUDGED without any."""
    order = list(Verdict)
    return max((f.verdict for f in findings), key=order.index, default=Verdict.NOT_JUDGED)
