"""Response and request bodies of the API."""

import time
from typing import Annotated, Any, Generic, Self, TypeVar

from fastapi import Response
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from mapserver.fleet.canary_controller import find
from mapserver.fleet_statistics.canary_decision import CanaryFinding, number_of
from mapserver.fleet_statistics.kpis import Kpis
from mapserver.floor_plan.survey_requests import SurveyRequest
from mapserver.quality.figures import TrustedCalibration
from mapserver.store import CanaryRow, FailureRow, PictureRow, VerdictRow, VersionInfo

T = TypeVar("T")


class VersionView(BaseModel):
    """A version; map_bytes is what a robot downloads for the whole site, vocabulary excluded.

    trusted_calibrations: those trusted by an operator, by name and reason, although no recording judged them.
    """

    model_config = ConfigDict(from_attributes=True)
    site: str
    version: int
    state: str
    parent: int | None
    created: str
    manifest_sha256: str
    tiles: int
    landmarks: int
    map_bytes: int
    vocabulary_sha256: str
    vocabulary_bytes: int
    trusted_calibrations: list[TrustedCalibration] = []

    @classmethod
    def of(cls, service: Any, info: VersionInfo) -> Self:
        trusted = service.store.trusted(info)
        return cls.model_validate(info).model_copy(update={"trusted_calibrations": trusted})


class Uploaded(BaseModel):
    """A recording that was uploaded."""

    name: str
    size_bytes: int


class QualityView(BaseModel):
    """Quality of a version: gate results, oldest first, calibrations trusted by an operator, and the build's report."""

    site: str
    version: int
    state: str
    verdicts: list[VerdictRow]
    trusted_calibrations: list[TrustedCalibration]
    report: dict[str, Any]


class KpisView(BaseModel):
    """The figures of one robot, version, tile, cause or site; key is empty for a site as a whole."""

    site: str
    key: str
    measures: Kpis


class HourView(BaseModel):
    """The figures of one hour; hour_ns: its start, nanoseconds since 1970."""

    hour_ns: int
    measures: Kpis


class FailureView(BaseModel):
    """One failure. report: the robot's report without pictures; pictures: those still stored."""

    failure: FailureRow
    report: dict[str, Any]
    pictures: list[PictureRow]


class CanaryView(BaseModel):
    """The latest canary version and its decision; robots: the known robots that take part."""

    canary: CanaryRow
    finding: CanaryFinding
    robots: list[str]

    @classmethod
    def of(cls, service: Any, row: CanaryRow) -> Self:
        robots = (robot.robot for robot in service.store.robots(row.site))
        members = [name for name in robots if number_of(row.site, row.version, name) < row.threshold]
        finding = find(service.store, row, service.settings.config.canary, time.time_ns())
        return cls(canary=row, finding=finding, robots=members)


class TokenView(BaseModel):
    """A valid token: its number, its scopes and its end. The token itself is not stored."""

    number: str
    scopes: list[str]
    ends_ns: int


class OperatorView(BaseModel):
    """An operator, or with the role `program` a name that has tokens alone. sessions: number of the open ones."""

    name: str
    role: str
    is_disabled: bool
    sessions: int
    tokens: list[TokenView]


class Bundle(Response):
    """The bundle of a robot as a file, a secret until it is used."""

    @classmethod
    def of(cls, _: Any, bundles: dict[str, bytes]) -> Self:
        ((robot, data),) = bundles.items()
        headers = {"Content-Disposition": f'attachment; filename="{robot}.fleetmap"', "Cache-Control": "no-store"}
        return cls(data, headers=headers, media_type="application/octet-stream")


class Secret(BaseModel):
    """A new password or token; no other answer has it."""

    name: str
    secret: str


class Act(BaseModel):
    """Reason and author of a change; with a session or token, the author is its name."""

    model_config = ConfigDict(extra="forbid")
    actor: Annotated[str | None, Field(min_length=1, max_length=200, examples=["ada"])] = None
    reason: Annotated[str, Field(max_length=2000, examples=["robots lose themselves in aisle 3"])] = ""


_NOT_FOUND: dict[str, JsonValue] = {
    **{"type": "about:blank", "title": "Not Found", "status": 404, "instance": "/v1/sites/hall/versions/9"},
    "detail": "site hall has no version 9; `mapserver versions --site hall` lists them",
}


class Problem(BaseModel):
    """An error, as RFC 9457 describes it."""

    model_config = ConfigDict(json_schema_extra={"examples": [_NOT_FOUND]})
    type: str
    title: str
    status: int
    detail: str
    instance: str


class AlertTest(BaseModel):
    """Answer of the webhook to an accepted test alert."""

    detail: str


class ServerVersion(BaseModel):
    """Version of the server, and the newest formats that it reads and writes."""

    fleetmap: str
    tile_format: int
    manifest_format: int


class ServiceState(BaseModel):
    """`ok`, or the missing part."""

    status: str


OK = ServiceState(status="ok")
GeoJson = dict[str, Any]
Survey = SurveyRequest


class Page(BaseModel, Generic[T]):
    """A part of a list, and the cursor of the following part, None after the last one."""

    items: list[T]
    next: str | None
