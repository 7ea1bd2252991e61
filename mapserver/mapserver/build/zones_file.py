"""The zones of a site, from the file that --zones names."""

from pathlib import Path

from fleetmap.config import Section, load_toml
from mapserver.survey.loops.zones import Zones, zones_of


class _ZonesFile(Section, frozen=True):
    zones: dict[str, object]


def read_zones(path: Path | None) -> Zones:
    """Zones from a TOML file: a table [zones] with name = [[x, y], ...] in metres; UsageError for anything else. None has no zones."""
    return Zones() if path is None else zones_of(load_toml(path, _ZonesFile).zones, str(path))
