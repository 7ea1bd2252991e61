"""What the store tells about the fleet's health: failures, traces, canaries."""

from dataclasses import dataclass

from fleetmap.messages import FailureReport

AXES = ("site", "robot", "version", "tile", "cause", "arm")
"""What the sums are kept by, each for itself: never robot and tile together, so that they stay small."""


@dataclass(frozen=True, slots=True)
class FailureRow:
    """One failure. happened_ns: when it began, by the server's clock; tile: "x,y"; kind `suspected`: an estimate."""

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


@dataclass(frozen=True, slots=True)
class PictureRow:
    """A picture of a failure: its place among them, kind (`frame`, `matches`) and bytes."""

    place: int
    kind: str
    stamp_ns: int
    bytes: int


@dataclass(frozen=True, slots=True)
class FailureDetail:
    """A failure with its context. report: without pictures; pictures: those that are still kept."""

    failure: FailureRow
    report: FailureReport
    pictures: list[PictureRow]


@dataclass(frozen=True, slots=True)
class FailureFilter:
    """Which failures; None is any. since_ns, until_ns: by `happened_ns`."""

    site: str | None = None
    robot: str | None = None
    version: int | None = None
    tile: str | None = None
    cause: str | None = None
    kind: str | None = None
    since_ns: int | None = None
    until_ns: int | None = None


@dataclass(frozen=True, slots=True)
class TraceRow:
    """Where a robot was and what its estimate was worth, thinned; hour: since 1970, by the server's clock."""

    site: str
    robot: str
    hour: int
    stamp_ns: int
    status: str
    version: int | None
    x_map_m: float | None
    y_map_m: float | None
    radius_95_m: float | None


@dataclass(frozen=True, slots=True)
class CanaryRow:
    """A version that some robots of a site try before the others. state: running, promoted, rolled_back or stopped.

    threshold: robots whose number (`canary.number_of`) is below it take part. outcome: why it ended, empty while it runs.
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
class FleetRetention:
    """What stays of the fleet's reports: sums and failures by age, pictures also by size, traces by age and count."""

    tally_days: float = 400.0
    failure_days: float = 400.0
    picture_bytes: int = 1_000_000_000
    trace_days: float = 2.0
    trace_rows: int = 3_000_000
