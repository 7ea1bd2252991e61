"""Settings of `locclient run` beside the source's, the output's and the localizer's."""

from fleetmap.config import Section
from locclient.maps.tile_cache import DEFAULT_MAX_BYTES
from locclient.maps.tile_selection import TileSelectionSettings
from locclient.robot.version_trial import TrialSettings


class RunSection(Section, frozen=True):
    """Who the robot is, where its map comes from, and what it may keep."""

    server: str | None = None
    store: str | None = None
    site: str | None = None
    robot: str | None = None
    prior: str | None = None
    cache: str | None = None
    cache_bytes: int = DEFAULT_MAX_BYTES
    spool: str | None = None
    spool_bytes: int = 50_000_000
    failures: str | None = None
    frame_queue: int = 2
    imu_wait_s: float = 0.05
    window: TileSelectionSettings = TileSelectionSettings()
    trial: TrialSettings = TrialSettings()
