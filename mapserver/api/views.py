"""Response and request bodies of the API."""

from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue, create_model, model_validator

from fleetmap.encoding import MOST
from fleetmap.mapformat.names import NAME_PATTERN
from mapserver.fleet.alerts import Alert
from mapserver.fleet.building import MOST_CORNERS
from mapserver.fleet.fleet import RobotStatus
from mapserver.fleet_statistics.canary_decision import CanaryFinding
from mapserver.fleet_statistics.kpis import Kpis
from mapserver.operators.operators import MAX_TOKEN_DAYS
from mapserver.operators.roles import OPERATOR_PATTERN, Role, Scope
from mapserver.quality.figures import TrustedCalibration
from mapserver.serving.bus_service import MOST_SIGMA_M
from mapserver.store import (
    CanaryRow,
    Event,
    FailureRow,
    JobInfo,
    MapStore,
    PictureRow,
    SiteInfo,
    VerdictRow,
    VersionInfo,
)
from mapserver.trust.enrolment import EnrolledRobot


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


def version_view(store: MapStore, info: VersionInfo) -> VersionView:
    """Return the API's view of a version."""
    return VersionView.model_validate(info).model_copy(update={"trusted_calibrations": store.trusted(info)})


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


class Secret(BaseModel):
    """A new password or token; no other answer has it."""

    name: str
    secret: str


Decimal = Annotated[float, Field(ge=-MOST, le=MOST)]


def _body(**example: JsonValue) -> ConfigDict:
    return ConfigDict(extra="forbid", json_schema_extra={"examples": [example]})


class Act(BaseModel):
    """Reason and author of a change; with a session or token, the author is its name."""

    model_config = _body(actor="ada", reason="robots lose themselves in aisle 3")
    actor: Annotated[str | None, Field(min_length=1, max_length=200)] = None
    reason: Annotated[str, Field(max_length=2000)] = ""


class PublishAct(Act):
    """Author and reason of publishing; `force` also publishes what the gate refuses, except beyond hard limits.

    With `trust_calibration` the author confirms the calibration although no recording judged it.
    """

    model_config = _body(actor="ada", reason="hall 2 was emptied", force=True)
    force: bool = False
    trust_calibration: bool = False

    @model_validator(mode="after")
    def _choice_has_a_reason(self) -> Self:
        if (self.force or self.trust_calibration) and not self.reason:
            raise ValueError(f"publishing {'by force' if self.force else 'with trust_calibration'} needs a reason")
        return self


class RollbackAct(Act):
    """Author and reason of a rollback.

    With `to` only where that version becomes current again, with `canary` only where it ends the trial of that `id`: else it is 409.
    """

    model_config = _body(actor="ada", reason="robots lose themselves in aisle 3", to=2)
    to: int | None = None
    canary: int | None = None


class CanaryAct(Act):
    """Author and reason of a canary; share of the robots, by default the setting's."""

    model_config = _body(actor="ada", reason="the nightly map", share=0.05)
    share: Annotated[float | None, Field(gt=0, lt=1)] = None


class PlaceAct(Act):
    """An operator's pose for a robot: metres in `map`, heading from x towards y, and its uncertainty (one sigma)."""

    model_config = _body(actor="ada", x_map_m=12.5, y_map_m=3.0, heading_rad=1.57, sigma_m=0.5)
    x_map_m: Decimal
    y_map_m: Decimal
    heading_rad: Decimal | None = None
    sigma_m: Annotated[float, Field(gt=0, le=MOST_SIGMA_M)] = 0.5


class SurveyAct(Act):
    """Author and reason of a survey request; corners of its polygon in metres of `map`, the first not repeated at the end."""

    model_config = _body(actor="ada", reason="racks were moved", corners_map_m=[[0, 0], [4, 0], [4, 3]])
    corners_map_m: Annotated[list[tuple[Decimal, Decimal]], Field(min_length=3, max_length=MOST_CORNERS)]


class RoleAct(Act):
    """Author and reason of another role."""

    model_config = _body(actor="ada", reason="she leads the shift", role="operator")
    role: Role


class OperatorAct(RoleAct):
    """Author and reason of a new operator, with name and role."""

    model_config = _body(actor="ada", reason="a new colleague", name="bob", role="operator")
    name: Annotated[str, Field(pattern=OPERATOR_PATTERN)]


class TokenAct(Act):
    """Author and reason of a token, its scopes and days. A name without an operator becomes a program's."""

    model_config = _body(actor="ada", reason="metrics", name="prometheus", scopes=["metrics"], days=90)
    name: Annotated[str, Field(pattern=OPERATOR_PATTERN)]
    scopes: Annotated[list[Scope], Field(min_length=1, max_length=len(Scope))]
    days: Annotated[float, Field(gt=0, le=MAX_TOKEN_DAYS)] = 90


class EnrolAct(Act):
    """Author and reason of an enrolment. endpoint: of the server as robots reach it, by default with the first name of its certificate."""

    model_config = _body(actor="ada", reason="a new robot", robot="tug-7")
    robot: Annotated[str, Field(pattern=NAME_PATTERN)]
    endpoint: Annotated[str | None, Field(max_length=300, pattern=r"^(tls|quic)/\S+:[0-9]{1,5}$")] = None


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


def _list(name: str, words: str, **fields: Any) -> Any:
    """The model of a part of a list: its items, what they are, and the cursor of the following part."""
    return create_model(name, __doc__=words, **fields, next=str | None)


SiteList = _list("SiteList", "Sites by name.", sites=list[SiteInfo])
VersionList = _list("VersionList", "Versions of a site, oldest first.", versions=list[VersionView])
RobotList = _list("RobotList", "Robots that ever reported, by site and name.", robots=list[RobotStatus])
EventList = _list(
    "EventList",
    "Events of a site, oldest first: actor, action, time (nanoseconds since 1970) and reason.",
    events=list[Event],
)
JobList = _list("JobList", "Jobs, newest first.", jobs=list[JobInfo])
KpisList = _list("KpisList", "Figures by site and key.", by=str, measures=list[KpisView])
HourList = _list(
    "HourList", "Figures by the hour, oldest first; hours without reports are left out.", hours=list[HourView]
)
FailureList = _list("FailureList", "Failures, the last to arrive first.", failures=list[FailureRow])
OperatorList = _list("OperatorList", "Operators and programs by name.", operators=list[OperatorView])
EnrolledList = _list("EnrolledList", "Enrolled robots of a site, by name.", robots=list[EnrolledRobot])
AlertList = _list(
    "AlertList",
    "Active alerts, by site, name and subject. since_ns: start; the time of the answer if it is unknown.",
    alerts=list[Alert],
)
