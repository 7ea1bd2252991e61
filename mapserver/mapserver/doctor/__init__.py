"""What is wrong with a recording, found before a survey fails on it. Analyses are pure.

`examination` reads the frames.
"""

from mapserver.doctor.findings import Finding, Verdict
from mapserver.doctor.run_checks import Examination, examine

__all__ = ["Examination", "Finding", "Verdict", "examine"]
