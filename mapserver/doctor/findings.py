"""Findings of the checks, and their limits."""

from collections.abc import Container, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple


class Verdict(StrEnum):
    """Severity of a finding, the best first. NOT_JUDGED is not OK. Only FAIL ends the command with another exit status."""

    OK = "ok"
    NOT_JUDGED = "not judged"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: its name, the measured value, its limit (with unit, as text), and the next step.

    missing: for a check that is not judged, or whose value is too uncertain to be corrected, the motion or sensor that would make
    it observable. A check that is not judged has a value only if one was measured that may be due to chance.
    """

    name: str
    verdict: Verdict
    value: float | None
    limit: str
    sentence: str
    missing: str = ""


class Limits(NamedTuple):
    """Values above which a check warns and fails, their unit as text, and both as text if they are of something else than the value."""

    warn_above: float
    fail_above: float
    unit: str = ""
    words: str = ""


def judge(name: str, value: float, limits: Limits, good: str, bad: str) -> Finding:
    """Return a finding on a value that should be small. `good` is its sentence if it is, `bad` (with the next step) if not."""
    warn_above, fail_above, unit, words = limits
    verdict = Verdict.FAIL if value > fail_above else Verdict.WARN if value > warn_above else Verdict.OK
    both = f"warn above {warn_above:g} {unit}, fail above {fail_above:g} {unit}".replace(" ,", ",").strip()
    return Finding(name, verdict, value, words or both, good if verdict is Verdict.OK else bad)


def not_judged(name: str, reason: str, missing: str) -> Finding:
    """Return a check that this recording cannot judge, with the missing data."""
    return Finding(name, Verdict.NOT_JUDGED, None, "", f"not judged: {reason}; {missing}", missing)


def worst(findings: Sequence[Finding]) -> Verdict:
    """Return the worst verdict; NOT_JUDGED for an empty list."""
    return max((f.verdict for f in findings), key=list(Verdict).index, default=Verdict.NOT_JUDGED)


def grouped(findings: Sequence[Finding]) -> list[tuple[list[Finding], str]]:
    """Group findings under one sentence each; checks without a value that lack the same data share one."""
    groups: dict[tuple[str, ...], list[Finding]] = {}
    for finding in findings:
        is_unknown = finding.verdict is Verdict.NOT_JUDGED and finding.value is None and finding.missing
        groups.setdefault((finding.missing,) if is_unknown else (finding.name, finding.sentence), []).append(finding)
    return [
        (same, f"{Verdict.NOT_JUDGED}: {same[0].missing}" if len(same) > 1 else same[0].sentence)
        for same in groups.values()
    ]


def summary(findings: Sequence[Finding], decisive: Container[str]) -> str:
    """Return all findings as one line, such as `24 ok, 2 not judged: good enough to build`; decisive: checks that a build requires."""
    counts = {verdict: sum(finding.verdict is verdict for finding in findings) for verdict in Verdict}
    shown = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    failed = [finding.name for finding in findings if finding.verdict is Verdict.FAIL]
    if refused := [name for name in failed if name in decisive]:
        return f"{shown}: a map of it would be wrong, `mapserver build` refuses it: {', '.join(refused)}"
    if failed:
        return f"{shown}: not good enough: {', '.join(failed)}"
    if counts[Verdict.OK] < counts[Verdict.NOT_JUDGED]:
        return f"{shown}: nothing is known to be wrong, but most could not be judged"
    return f"{shown}: good enough to build" + (", with the warnings below" if counts[Verdict.WARN] else "")
