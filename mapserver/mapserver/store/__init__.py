"""Where maps are kept: content-addressed files and one SQLite database. SQL lives here alone."""

from mapserver.store.map_store import MapStore
from mapserver.store.rows import DraftDetails, Event, RobotInfo, SiteInfo, VersionInfo

__all__ = ["DraftDetails", "Event", "MapStore", "RobotInfo", "SiteInfo", "VersionInfo"]
