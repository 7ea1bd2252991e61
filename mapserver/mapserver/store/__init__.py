"""Where maps are kept: content-addressed files and one SQLite database. SQL lives here alone."""

from mapserver.store.collection import Garbage, Retention
from mapserver.store.differences import Difference
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

__all__ = [
    "NOBODY",
    "Actor",
    "Difference",
    "DraftDetails",
    "Event",
    "Findings",
    "Garbage",
    "JobInfo",
    "MapStore",
    "Retention",
    "RobotInfo",
    "SiteInfo",
    "VerdictRow",
    "VersionInfo",
]
