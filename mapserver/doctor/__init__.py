"""Checks of a recording before it is surveyed. The analyses are pure; `run_checks` reads the frames."""

from mapserver.doctor.findings import Finding, Verdict
from mapserver.doctor.run_checks import CheckResults, run_checks

__all__ = ["CheckResults", "Finding", "Verdict", "run_checks"]
