"""What the store tells about versions, robots and events."""

from dataclasses import dataclass
from typing import Any

import msgspec

from fleetmap.mapformat import CameraEntry, RecordingEntry


@dataclass(frozen=True, slots=True)
class VersionInfo:
    """One version of a site. state: draft, published, current or retired."""

    site: str
    version: int
    state: str
    parent: int | None
    created: str
    published_ns: int | None
    manifest_sha256: str
    manifest_bytes: int
    tiles: int
    tile_bytes: int
    landmarks: int
    vocabulary_sha256: str
    vocabulary_bytes: int
    archive_sha256: str | None
    saved_ns: int
    retired_ns: int | None

    @property
    def map_bytes(self) -> int:
        """What a robot downloads for the whole site, vocabulary apart."""
        return self.manifest_bytes + self.tile_bytes


@dataclass(frozen=True, slots=True)
class SiteInfo:
    """One site and its current version, if any."""

    site: str
    current_version: int | None
    versions: int
    vocabulary_sha256: str | None


@dataclass(frozen=True, slots=True)
class RobotInfo:
    """What a robot said last: the version it runs (None before its first acknowledgement) and its report."""

    site: str
    robot: str
    version: int | None
    last_seen_ns: int
    last_report: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Actor:
    """Who acts, and why; empty where the program acts by itself."""

    name: str = ""
    reason: str = ""


NOBODY = Actor()


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to a site, by whom and why."""

    id: int
    stamp_ns: int
    site: str
    kind: str
    detail: str
    version: int | None
    actor: str
    reason: str


@dataclass(frozen=True, slots=True)
class VerdictRow:
    """What the gate said about a version: reasons to refuse it (none if accepted), and what it looked at."""

    stamp_ns: int
    accepted: bool
    forced: bool
    reasons: tuple[str, ...]
    report: dict[str, Any]


@dataclass(frozen=True, slots=True)
class JobInfo:
    """One run of a job. state: running, done or failed; started and finished are ISO 8601 in UTC."""

    id: int
    site: str
    kind: str
    state: str
    started: str
    finished: str | None
    message: str
    report: dict[str, Any]


class DraftDetails(msgspec.Struct, frozen=True, kw_only=True):
    """The fields of a draft's manifest that only the survey knows; `created` is ISO 8601 in UTC."""

    created: str
    tile_size_m: float
    camera: CameraEntry
    recordings: tuple[RecordingEntry, ...]
    configuration: dict[str, Any]
    libraries: dict[str, str]
    report: dict[str, Any]
