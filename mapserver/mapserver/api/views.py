"""What the API shows, as its own types: the store may change its rows without changing an answer."""

from dataclasses import dataclass
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from mapserver.fleet.fleet import RobotStatus
from mapserver.store import Actor, Event, JobInfo, SiteInfo, VerdictRow, VersionInfo


@dataclass(frozen=True, slots=True)
class SiteView:
    """A site and its current version, null before the first publication."""

    site: str
    current_version: int | None
    versions: int
    vocabulary_sha256: str | None

    @classmethod
    def of(cls, info: SiteInfo) -> "SiteView":
        """The view of a row."""
        return cls(info.site, info.current_version, info.versions, info.vocabulary_sha256)


@dataclass(frozen=True, slots=True)
class VersionView:
    """A version; map_bytes is what a robot downloads for the whole site, vocabulary apart."""

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

    @classmethod
    def of(cls, info: VersionInfo) -> "VersionView":
        """The view of a row."""
        return cls(
            site=info.site,
            version=info.version,
            state=info.state,
            parent=info.parent,
            created=info.created,
            manifest_sha256=info.manifest_sha256,
            tiles=info.tiles,
            landmarks=info.landmarks,
            map_bytes=info.map_bytes,
            vocabulary_sha256=info.vocabulary_sha256,
            vocabulary_bytes=info.vocabulary_bytes,
        )


@dataclass(frozen=True, slots=True)
class SiteList:
    """Sites by name."""

    sites: list[SiteView]
    next: str | None


@dataclass(frozen=True, slots=True)
class VersionList:
    """Versions of a site, oldest first."""

    versions: list[VersionView]
    next: str | None


@dataclass(frozen=True, slots=True)
class RobotList:
    """Robots that ever reported, by site and name."""

    robots: list[RobotStatus]
    next: str | None


@dataclass(frozen=True, slots=True)
class EventList:
    """What happened to a site, oldest first: who did what, when (nanoseconds since 1970) and why."""

    events: list[Event]
    next: str | None


@dataclass(frozen=True, slots=True)
class JobList:
    """Jobs, newest first."""

    jobs: list[JobInfo]
    next: str | None


@dataclass(frozen=True, slots=True)
class QualityView:
    """What is known about a version's quality: what the gate said, oldest first, and the build's report."""

    site: str
    version: int
    state: str
    verdicts: list[VerdictRow]
    report: dict[str, Any]


class Act(BaseModel):
    """Who changes something, and why."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"actor": "ada", "reason": "robots lose themselves in aisle 3"}]},
    )
    actor: Annotated[str, Field(min_length=1, max_length=200)]
    reason: Annotated[str, Field(max_length=2000)] = ""

    def who(self) -> Actor:
        """As the store keeps it."""
        return Actor(self.actor, self.reason)


class PublishAct(Act):
    """Who publishes, and why; with `force` also what the gate refuses, except beyond hard limits."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"actor": "ada", "reason": "hall 2 was emptied", "force": True}]},
    )
    force: bool = False

    @model_validator(mode="after")
    def _force_has_a_reason(self) -> Self:
        if self.force and not self.reason:
            raise ValueError("publishing by force needs a reason")
        return self


class Problem(BaseModel):
    """An error, as RFC 9457 describes it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "type": "about:blank",
                    "title": "Not Found",
                    "status": 404,
                    "detail": "site hall has no version 9; `mapserver versions --site hall` lists them",
                    "instance": "/v1/sites/hall/versions/9",
                }
            ]
        }
    )
    type: str
    title: str
    status: int
    detail: str
    instance: str


@dataclass(frozen=True, slots=True)
class ServerVersion:
    """What runs here, and the newest formats that it reads and writes."""

    fleetmap: str
    tile_format: int
    manifest_format: int


@dataclass(frozen=True, slots=True)
class State:
    """`ok`, or what is missing."""

    status: str
