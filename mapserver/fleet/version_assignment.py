"""Assignment of versions to the robots of a site."""

from dataclasses import dataclass

from fleetmap.messages import WantedVersion
from mapserver.fleet_statistics.canary_decision import number_of
from mapserver.store import CanaryRow, MapStore


@dataclass(frozen=True, slots=True)
class VersionAssignment:
    """The current version, and the one that some robots try before the others; None where there is none."""

    current: WantedVersion
    canary: CanaryRow | None
    tried: WantedVersion | None

    def is_canary(self, robot: str) -> bool:
        """Whether this robot tries a version before the others."""
        canary = self.canary
        return canary is not None and number_of(canary.site, canary.version, robot) < canary.threshold

    def wanted(self, robot: str) -> WantedVersion:
        """The version that this robot should run."""
        return self.tried if self.tried is not None and self.is_canary(robot) else self.current


def read_assignment(store: MapStore, site: str) -> VersionAssignment:
    """The assignment of a site as it is now; raises UsageError for an unknown one."""
    info, running = store.current(site), store.canaries(site, running=True)
    number, address = (None, None) if info is None else (info.version, info.manifest_sha256)
    current = WantedVersion(site=site, version=number, manifest_sha256=address)
    if not running:
        return VersionAssignment(current, None, None)
    number, address = running[0].version, store.version(site, running[0].version).manifest_sha256
    return VersionAssignment(current, running[0], WantedVersion(site=site, version=number, manifest_sha256=address))
