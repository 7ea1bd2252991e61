"""Figures of an acceptance report; docs/acceptance.md lists them. Pure."""

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from mapserver.fleet_statistics.kpis import Share, share
from mapserver.quality.figures import RigEvidence

FORMAT = 2
UNKNOWN_PLACE, ALL = "unknown place", "all areas"
QUANTILES = {"median": 0.5, "p95": 0.95, "p99": 0.99}


class Count(msgspec.Struct):
    """`hits` of `tries`."""

    hits: int = 0
    tries: int = 0

    def __add__(self, other: "Count") -> "Count":
        return Count(self.hits + other.hits, self.tries + other.tries)

    @property
    def share(self) -> Share:
        """With its exact 95 % interval."""
        return share(self.hits, self.tries)

    @property
    def text(self) -> str:
        return f"{self.hits} of {self.tries}" if self.tries else "–"


class StartCounts(msgspec.Struct):
    """Starts without a guess by their outcome; silent: silent failures by
    `fleetmap.failure_definition`, and what may have become one at the end."""

    found: int = 0
    ambiguous: int = 0
    lost: int = 0
    silent: int = 0

    @property
    def found_of_all(self) -> Count:
        return Count(self.found, self.found + self.ambiguous + self.lost + self.silent)


class AreaFigures(msgspec.Struct):
    """An area of the site, or a tile outside of all areas.

    places: of the map in it; seen and missing: headings as in TileDirections. frames: held-out ones localized from a prior at their own
    place; wrong: those of them at a wrong place; errors_mm: of the others. grey: median level of its pictures. darkness: frames still
    localized by stops (powers of two) of lost light; blur: by the length of the blur in pixels.
    """

    name: str
    places: int = 0
    seen: dict[str, int] = {}
    missing: dict[str, int] = {}
    frames: Count = msgspec.field(default_factory=Count)
    wrong: int = 0
    errors_mm: list[float] = []
    starts: StartCounts = msgspec.field(default_factory=StartCounts)
    grey: float | None = None
    darkness: dict[str, Count] = {}
    blur: dict[str, Count] = {}


class Similar(msgspec.Struct, frozen=True):
    """Number of frames of an area that robots accept at another place, too."""

    area: str
    other: str
    frames: int


class DriveFigures(msgspec.Struct, frozen=True):
    """A drive through the site, played by the robots' localizer.

    day: of its first frame in UTC, None for a clock that does not count from 1970. reference: source of its poses. is_surveyed: True if
    the version was made of it. failures and silent: position failures by `fleetmap.failure_definition`. errors_mm: max, and the quantiles
    that its number of frames can give. docks_mm: distance of the estimate at each dock from the dock's place. calibration: evidence of this
    drive on its rig; remarks: the doctor's findings that are not good.
    """

    name: str
    sha256: str
    day: str | None
    frames: int
    hours: float
    reference: str
    is_surveyed: bool
    localised_share: float
    failures: int
    silent: int
    errors_mm: dict[str, float | None] | None
    docks_mm: list[float]
    calibration: RigEvidence
    remarks: list[str]


class Figure(msgspec.Struct, frozen=True):
    """A line of the table: of the site, its weakest area or drive, and its limit; is_met: None without one, or if too little was tried."""

    name: str
    site: str
    weakest: str
    limit: str
    is_met: bool | None


class Numbered(msgspec.Struct, kw_only=True):
    """What a report of any format tells."""

    format: int = FORMAT


class Report(Numbered, kw_only=True):
    """The report.

    program: version of fleetmap. promises: the operator's statements. reasons: against the site. figures: the table. similar: places that
    look alike, of similar_of frames. darkest_grey: grey level at which pictures of this site give no fix any more. fleet: failures a
    robot-day that the robots reported in this version, None if they drove too little. better and worse: against an earlier report.
    """

    verdict: str = ""
    is_accepted: bool = False
    site: str
    version: int
    manifest_sha256: str
    created: str
    program: str = ""
    promises: list[str]
    reasons: list[str] = []
    survey_again: list[str] = []
    not_judged: list[str] = []
    figures: list[Figure] = []
    areas: list[AreaFigures]
    drives: list[DriveFigures]
    similar: list[Similar]
    similar_of: int
    darkest_grey: float | None
    calibrations: list[RigEvidence]
    fleet: str | None = None
    compared_with: str | None = None
    better: list[str] = []
    worse: list[str] = []

    @property
    def remarks(self) -> list[str]:
        """What the doctor says of the drives."""
        return [f"{drive.name}: {words}" for drive in self.drives for words in drive.remarks]

    @property
    def whole(self) -> AreaFigures:
        """All areas together."""
        sums = AreaFigures(ALL)
        for area in self.areas:
            sums.wrong += area.wrong
            sums.frames += area.frames
            sums.errors_mm = [*sums.errors_mm, *area.errors_mm]
            for name in StartCounts.__struct_fields__:
                setattr(sums.starts, name, getattr(sums.starts, name) + getattr(area.starts, name))
            for mine, other in ((sums.darkness, area.darkness), (sums.blur, area.blur)):
                mine.update({level: mine.get(level, Count()) + count for level, count in other.items()})
        return sums


def fewest(share_: float) -> int:
    """Return the fewest values of which the largest is beyond a quantile with 95 %: fewer do not give it. Source: Wilks 1941."""
    return math.ceil(math.log(0.05) / math.log(share_))


def quantile(values: Sequence[float], share_: float) -> float | None:
    """Return a quantile, to 0.01; None of too few values for it."""
    return round(float(np.quantile(values, share_)), 2) if len(values) >= fewest(share_) else None
