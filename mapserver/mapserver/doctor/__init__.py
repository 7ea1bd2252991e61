"""What is wrong with a recording, found before a survey fails on it. Analyses are pure.

`examination` reads the frames.
"""

from mapserver.doctor.examination import Examination, examine
from mapserver.doctor.findings import Finding, Verdict

__all__ = ["Examination", "Finding", "Verdict", "examine"]
