"""Maps on the disk: content-addressed files and one SQLite database. SQL lives here alone."""

from mapserver.store.fleet_queries import CounterKey, FleetBatch, tile_key
from mapserver.store.garbage_collection import Retention
from mapserver.store.map_store import MapStore
from mapserver.store.rows import (
    NOBODY,
    Actor,
    CanaryRow,
    DraftContent,
    DraftDetails,
    Event,
    FailureDetail,
    FailureFilter,
    FailureRow,
    FleetRetention,
    JobInfo,
    NewCanary,
    PictureRow,
    SiteInfo,
    TraceRow,
    VerdictRow,
    VersionInfo,
)

__all__ = [
    "NOBODY",
    "Actor",
    "CanaryRow",
    "CounterKey",
    "DraftContent",
    "DraftDetails",
    "Event",
    "FailureDetail",
    "FailureFilter",
    "FailureRow",
    "FleetBatch",
    "FleetRetention",
    "JobInfo",
    "MapStore",
    "NewCanary",
    "PictureRow",
    "Retention",
    "SiteInfo",
    "TraceRow",
    "VerdictRow",
    "VersionInfo",
    "tile_key",
]
