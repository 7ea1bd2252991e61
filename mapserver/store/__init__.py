"""Maps on the disk: content-addressed files and one SQLite database. All SQL is here."""

from mapserver.store.access.chain import AuditLine, chain_faults
from mapserver.store.access.operators import OperatorQueries, OperatorRow, TokenRow
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
    FailureReplay,
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
from mapserver.store.usage import DiskSpace, StoreUsage

__all__ = [
    "NOBODY",
    "Actor",
    "AuditLine",
    "CanaryRow",
    "CounterKey",
    "DiskSpace",
    "DraftContent",
    "DraftDetails",
    "Event",
    "FailureDetail",
    "FailureFilter",
    "FailureReplay",
    "FailureRow",
    "FleetBatch",
    "FleetRetention",
    "JobInfo",
    "MapStore",
    "NewCanary",
    "OperatorQueries",
    "OperatorRow",
    "PictureRow",
    "Retention",
    "SiteInfo",
    "StoreUsage",
    "TokenRow",
    "TraceRow",
    "VerdictRow",
    "VersionInfo",
    "chain_faults",
    "tile_key",
]
