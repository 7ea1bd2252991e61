"""Loops of builds as reports of jobs tell them: which build a job is about, and where its loops begin and end. Pure."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

MOST_LOOPS = 3000


@dataclass(frozen=True, slots=True)
class Loop:
    """A revisit between two places, x and y in `map`, and what became of it."""

    start_map_m: tuple[float, float]
    end_map_m: tuple[float, float]
    verdict: str

    @property
    def is_accepted(self) -> bool:
        """Whether the map is held together by it."""
        return self.verdict == "accepted"


def builds_of(report: dict[str, Any]) -> list[dict[str, Any]]:
    """The builds in a job's report: those of a night, else the report itself."""
    return list(dicts(report.get("builds"))) or [report]


def loops_of_version(reports: Iterable[dict[str, Any]], version: int) -> list[Loop]:
    """Loops of the build that made a version, by the first of these reports of jobs that tells them; none where none does."""
    for report in reports:
        for build in builds_of(report):
            if build.get("version") == version:
                return _loops(build)[:MOST_LOOPS]
    return []


def _loops(build: dict[str, Any]) -> list[Loop]:
    found = []
    for place in dicts(build.get("loop_places")):
        ends = ends_of(place)
        if ends is not None:
            found.append(Loop(*ends, str(place.get("verdict"))))
    return sorted(found, key=lambda loop: not loop.is_accepted)


def ends_of(place: dict[str, Any]) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Both ends of a loop, None unless the report has two numbers for each."""
    ends: Sequence[Any] = (place.get("from_map_m"), place.get("to_map_m"))
    if not all(
        isinstance(end, list) and len(end) == 2 and all(isinstance(v, int | float) for v in end) for end in ends
    ):
        return None
    (x, y), (to_x, to_y) = ends
    return (float(x), float(y)), (float(to_x), float(to_y))


def dicts(value: object) -> Iterable[dict[str, Any]]:
    """The objects of a list; none of what is no list."""
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []
