"""What the API shows of the fleet's health."""

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from mapserver.api.views import Act
from mapserver.fleet_statistics.canary_test import CanaryFinding
from mapserver.fleet_statistics.kpis import Kpis
from mapserver.store import CanaryRow, FailureRow, PictureRow


@dataclass(frozen=True, slots=True)
class KpisView:
    """The figures of one robot, version, tile, cause or site; key is empty for a site as a whole."""

    site: str
    key: str
    measures: Kpis


@dataclass(frozen=True, slots=True)
class KpisList:
    """Figures by site and key."""

    by: str
    measures: list[KpisView]
    next: str | None


@dataclass(frozen=True, slots=True)
class HourView:
    """The figures of one hour; hour_ns: its begin, nanoseconds since 1970."""

    hour_ns: int
    measures: Kpis


@dataclass(frozen=True, slots=True)
class HourList:
    """Figures by the hour, oldest first; hours without reports are left out."""

    hours: list[HourView]
    next: str | None


@dataclass(frozen=True, slots=True)
class FailureList:
    """Failures, the last to arrive first."""

    failures: list[FailureRow]
    next: str | None


@dataclass(frozen=True, slots=True)
class FailureView:
    """One failure. report: all that the robot told, without pictures; pictures: those that are still kept."""

    failure: FailureRow
    report: dict[str, Any]
    pictures: list[PictureRow]


@dataclass(frozen=True, slots=True)
class CanaryView:
    """The last version that some robots tried first, and what its counts say; robots: those that take part and are known."""

    canary: CanaryRow
    finding: CanaryFinding
    robots: list[str]


class CanaryAct(Act):
    """Who lets some robots try a version, and why; share of the robots, the setting's without it."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"actor": "ada", "reason": "the nightly map", "share": 0.05}]},
    )
    share: Annotated[float | None, Field(gt=0, lt=1)] = None
