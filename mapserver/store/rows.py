"""Records of a store. Most are rows of a table that `schema` makes of their fields."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec

from fleetmap.mapformat.manifest import CameraEntry, RecordingEntry
from fleetmap.mapformat.tile import Tile
from fleetmap.messages import FailureReport
from mapserver.quality.figures import Evidence

UNLIMITED = 1 << 62
"""As limit of a number of rows: all."""

INCIDENT = "incident"
"""Kind of an event: what somebody does about an incident. Its detail: what, and behind `: ` the incident's id."""

AXES = ("site", "robot", "version", "tile", "area", "cause", "arm")
"""Keys of the sums, each separate: never robot and tile together, so that they stay few."""


@dataclass(frozen=True, slots=True)
class VersionInfo:
    """One version of a site. state: draft, published, current or retired; job: the job that saved it, if known."""

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
    job: int | None = None

    @property
    def map_bytes(self) -> int:
        """Download size for the whole site, vocabulary excluded."""
        return self.manifest_bytes + self.tile_bytes


@dataclass(frozen=True, slots=True)
class SiteInfo:
    """One site and its current version, if any."""

    site: str
    current_version: int | None
    versions: int


@dataclass(frozen=True, slots=True)
class RobotInfo:
    """Last report of a robot: its version (None before its first acknowledgement) and its report."""

    site: str
    robot: str
    version: int | None
    last_seen_ns: int
    last_report: dict[str, Any]


class Actor(NamedTuple):
    """Author of a change, and reason; empty for automatic changes.

    operator: the name authenticated by a session or token, empty if `name` was only typed; address: of the request.
    """

    name: str = ""
    reason: str = ""
    operator: str = ""
    address: str = ""


NOBODY = Actor()


@dataclass(frozen=True, slots=True)
class Event:
    """An event of a site, with author and reason."""

    id: int
    stamp_ns: int
    site: str
    kind: str
    detail: str
    version: int | None
    actor: str
    reason: str


@dataclass(frozen=True, slots=True)
class AuditLine(Event):
    """One line of the log. operator: the authenticated name, empty if none; address: of the request; sha256: chains the lines."""

    operator: str
    address: str
    sha256: str


@dataclass(frozen=True, slots=True)
class VerdictRow:
    """The gate's verdict on a version: reasons to refuse it (none if accepted), and the checked figures."""

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
    """The fields of a draft's manifest known only to the survey; `created` is ISO 8601 in UTC."""

    created: str
    tile_size_m: float
    camera: CameraEntry
    recordings: tuple[RecordingEntry, ...]
    configuration: dict[str, Any]
    libraries: dict[str, str]
    report: dict[str, Any]


class DraftContent(NamedTuple):
    """A new draft. archive: the whole survey; extras: bytes that localization does not need, by kind in `EXTRA_TABLES`; evidence: for the
    gate. job: number of the job that built it.
    """

    tiles: Sequence[Tile]
    vocabulary: bytes
    details: DraftDetails
    archive: bytes | None = None
    extras: Sequence[tuple[str, bytes]] = ()
    evidence: Evidence | None = None
    job: int | None = None


@dataclass(frozen=True, slots=True)
class FailureRow:
    """One failure. happened_ns: its start, by the server's clock; tile: "x,y"; kind `suspected`: an estimate.

    area: the named area of the position, by the site's present areas.
    """

    number: int
    site: str
    robot: str
    failure_id: str
    received_ns: int
    happened_ns: int
    duration_s: float
    kind: str
    cause: str
    status: str
    version: int | None
    tile: str | None
    x_map_m: float | None
    y_map_m: float | None
    area: str | None = None

    @property
    def where(self) -> str | None:
        return self.area or (None if self.tile is None else f"tile {self.tile}")


@dataclass(frozen=True, slots=True)
class PictureRow:
    """A picture of a failure: its place among them, kind (`frame`, `matches`) and bytes."""

    place: int
    kind: str
    stamp_ns: int
    bytes: int


class FailureDetail(NamedTuple):
    """A failure with its context. report: without pictures; pictures: those still stored."""

    failure: FailureRow
    report: FailureReport
    pictures: list[PictureRow]


class FailureReplay(NamedTuple):
    """A failure's recording: its summary, the MCAP file, and stamps and JPEG files of its left pictures."""

    summary: bytes
    mcap: bytes
    pictures: list[tuple[int, bytes]]


@dataclass(frozen=True, slots=True)
class FailureFilter:
    """Filter of failures; None matches any. since_ns, until_ns: by `happened_ns`."""

    site: str | None = None
    robot: str | None = None
    version: int | None = None
    tile: str | None = None
    cause: str | None = None
    kind: str | None = None
    since_ns: int | None = None
    until_ns: int | None = None
    area: str | None = None


@dataclass(frozen=True, slots=True)
class TraceRow:
    """Position of a robot and quality of its estimate, thinned; hour: since 1970, by the server's clock.

    heard_ns: by the same clock; flags: with commas; frame_ms: CPU of a frame, mean of the latest.
    exposure, sharpness: of the left camera's last image.
    """

    site: str
    robot: str
    hour: int
    stamp_ns: int
    status: str
    version: int | None
    x_map_m: float | None
    y_map_m: float | None
    radius_95_m: float | None
    heard_ns: int
    flags: str | None = None
    frame_ms: float | None = None
    exposure: float | None = None
    sharpness: float | None = None


@dataclass(frozen=True, slots=True)
class CanaryRow:
    """A version that some robots of a site run before the others. state: running, promoted, rolled_back or stopped.

    threshold: robots whose number (`canary.number_of`) is below it take part. outcome: reason of its end, empty while it runs.
    """

    id: int
    site: str
    version: int
    base_version: int
    share: float
    threshold: float
    state: str
    started_ns: int
    ended_ns: int | None
    actor: str
    reason: str
    outcome: str


@dataclass(frozen=True, slots=True)
class OperatorRow:
    """One operator. role: viewer, operator, admin, or program for a name that has only tokens; password: its argon2 hash."""

    name: str
    role: str
    password: str | None
    is_disabled: int
    tokens: int = 0
    sessions: int = 0


class SessionRow(NamedTuple):
    """A session, with the present role of its operator."""

    name: str
    role: str
    begun_ns: int
    used_ns: int


@dataclass(frozen=True, slots=True)
class TokenRow:
    """A token: its owner, its scopes (separated by spaces), its end and its hash."""

    name: str
    role: str
    scopes: str
    ends_ns: int
    sha256: str = ""


class SiteReleases(NamedTuple):
    """State of a site's releases: its versions by number, and the running canary, if any.

    rollback_target: the previous current version, None if absent. files: addresses of the site's files for robots, by kind.
    """

    site: str
    versions: dict[int, VersionInfo]
    rollback_target: int | None
    canary: CanaryRow | None
    files: dict[str, str]

    @property
    def current(self) -> VersionInfo | None:
        """The current version, None before the first publication."""
        return next((info for info in self.versions.values() if info.state == "current"), None)


class Retention(NamedTuple):
    """Retention rules of versions. keep_versions, keep_drafts: the newest of each site, besides protected ones.

    keep_days: time for which a retired version or superfluous draft is kept; robot_days: time for which a silent robot counts as
    using the version that it reported.
    """

    keep_versions: int = 5
    keep_drafts: int = 3
    keep_days: float = 7.0
    robot_days: float = 30.0


@dataclass(frozen=True, slots=True)
class FleetRetention:
    """Periods after which data is removed. Of the fleet's reports: sums and failures by age, failures also by number per robot, their
    pictures by age and size, their recordings by age (and size, by `replay_bytes`), traces by age and number.

    survey_picture_days: of the small pictures in versions of maps; recording_days: of recordings in an inbox since it was put away.
    """

    tally_days: float = 400.0
    failure_days: float = 400.0
    picture_bytes: int = 1_000_000_000
    trace_days: float = 2.0
    trace_rows: int = 3_000_000  # whole hours are deleted, the oldest first
    failures_per_robot: int = 5000  # twelve a day for 400 days
    picture_days: float = 30.0
    replay_days: float = 30.0
    survey_picture_days: float = 400.0
    recording_days: float = 400.0
