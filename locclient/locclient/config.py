"""The robot's configuration file: one section for the command line, one for the localizer."""

from fleetmap.config import Section
from fleetmap.recordings import Topics
from locclient.daemon.publishers import OutputSection
from locclient.daemon.run_settings import RunSection
from locclient.localization.settings import LocalizerSettings
from locclient.maps.tile_cache import DEFAULT_MAX_BYTES
from locclient.sensors.source import SourceSection


class ReplaySection(Section, frozen=True):
    """Options of `locclient replay`; the command line goes before them."""

    server: str | None = None
    store: str | None = None
    site: str | None = None
    robot: str = "replay"
    frames: str = ":"
    calibration: str | None = None
    prior: str | None = None
    reverse: bool = False
    realtime: bool = False
    report: str | None = None
    trajectory: str | None = None
    picture: str | None = None
    cache: str | None = None
    cache_bytes: int = DEFAULT_MAX_BYTES


class LocclientConfig(Section, frozen=True):
    """All of it."""

    replay: ReplaySection = ReplaySection()
    run: RunSection = RunSection()
    source: SourceSection = SourceSection()
    output: OutputSection = OutputSection()
    topics: Topics = Topics()
    localizer: LocalizerSettings = LocalizerSettings()
