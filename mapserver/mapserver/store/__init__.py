"""Where maps are kept: content-addressed files and one SQLite database. SQL lives here alone."""

from mapserver.store.fleet_records import FleetBatch, FleetRecords, TallyKey, tile_key
from mapserver.store.fleet_rows import (
    AXES,
    CanaryRow,
    FailureDetail,
    FailureFilter,
    FailureRow,
    FleetRetention,
    PictureRow,
    TraceRow,
)
from mapserver.store.garbage_collection import Garbage, Retention
from mapserver.store.map_store import MapStore
from mapserver.store.rows import (
    NOBODY,
    Actor,
    DraftDetails,
    Event,
    JobInfo,
    RobotInfo,
    SiteInfo,
    VerdictRow,
    VersionInfo,
)
from mapserver.store.verification import Findings
from mapserver.store.version_diff import Difference

__all__ = [
    "AXES",
    "NOBODY",
    "Actor",
    "CanaryRow",
    "Difference",
    "DraftDetails",
    "Event",
    "FailureDetail",
    "FailureFilter",
    "FailureRow",
    "Findings",
    "FleetBatch",
    "FleetRecords",
    "FleetRetention",
    "Garbage",
    "JobInfo",
    "MapStore",
    "PictureRow",
    "Retention",
    "RobotInfo",
    "SiteInfo",
    "TallyKey",
    "TraceRow",
    "VerdictRow",
    "VersionInfo",
    "tile_key",
]
