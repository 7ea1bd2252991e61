"""Loops of builds as reports of jobs tell them: which build a job is about, and where its loops begin and end. Pure."""

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import msgspec

MOST_LOOPS = 3000
VERDICTS = {
    "accepted": ("good", "accepted"),
    "ambiguous": ("warn", "refused as several places fit"),
    "rejected": ("bad", "refused by what is seen"),
    "gated_out": ("quiet", "refused by position"),
}
"""Tone and words of what becomes of a revisit."""


class Loop(msgspec.Struct, frozen=True):
    """A revisit of a recording between two places, x and y in `map`, what became of it and why, and how alike they look."""

    start_map_m: tuple[float, float] = msgspec.field(name="from_map_m")
    end_map_m: tuple[float, float] = msgspec.field(name="to_map_m")
    verdict: str
    reason: str = ""
    recording: str = ""
    score: float | None = None

    @property
    def is_accepted(self) -> bool:
        """Whether the map is held together by it."""
        return self.verdict == "accepted"


def builds_of(report: dict[str, Any]) -> list[dict[str, Any]]:
    """The builds in a job's report: those of a night, else the report itself."""
    return dicts(report.get("builds")) or [report]


def loops_of_version(reports: Iterable[dict[str, Any]], version: int) -> list[Loop]:
    """Loops of the build that made a version, by the first of these reports of jobs that tells them; none where none does."""
    builds = (build for report in reports for build in builds_of(report) if build.get("version") == version)
    return loops_of(next(builds, {}))


def loops_of(build: dict[str, Any]) -> list[Loop]:
    """Loops of a build, accepted ones first, without those that have no two numbers for each end."""
    found = []
    for place in dicts(build.get("loop_places")):
        with suppress(msgspec.ValidationError):
            found.append(msgspec.convert(place, Loop))
    return sorted(found, key=lambda loop: not loop.is_accepted)[:MOST_LOOPS]


def dicts(value: object) -> list[dict[str, Any]]:
    """The objects of a list; none of what is no list."""
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []
