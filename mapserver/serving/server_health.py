"""Health of the server itself: disk, store, memory, what expires, retention, faults of storage."""

import resource
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import fleetmap
from fleetmap.errors import StateError, StoreError, UsageError
from mapserver.fleet.fleet import Fleet
from mapserver.fleet.ingest import IngestSettings
from mapserver.store import DiskSpace, FleetRetention, MapStore, StoreUsage
from mapserver.trust.http_certificate import ENDS_SOON_DAYS, HttpCertificate
from mapserver.trust.status import trust_status

HTTP = "http"
"""Name of the certificate of HTTP among those of the bus, which are named by their files."""


@dataclass(frozen=True, slots=True)
class Ending:
    """A certificate or signed list. days_left: None if unknown; fault: why it needs somebody now, empty if it does not."""

    kind: Literal["certificate", "signed list"]
    name: str
    days_left: float | None
    fault: str = ""


@dataclass(frozen=True, slots=True)
class ServerHealth:
    """State of one server. memory_bytes: of its process, resident; store: None while it is measured for the first time.

    retention: of robots' reports; replay_bytes: of failures' recordings. storage_fault: why reports of robots cannot be stored at
    present, empty if they can.
    """

    fleetmap: str
    disk: DiskSpace
    store: StoreUsage | None
    memory_bytes: int
    endings: list[Ending]
    retention: FleetRetention
    replay_bytes: int
    storage_fault: str


def server_health(
    store: MapStore, fleet: Fleet, ingest: IngestSettings, certificate: HttpCertificate | None
) -> ServerHealth:
    """Return the state of the server; StoreError if the disk does not answer."""
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    return ServerHealth(
        fleetmap=str(fleetmap.__version__),
        disk=store.disk_space(),
        store=store.usage(),
        memory_bytes=pages * resource.getpagesize(),
        endings=[*_of_http(certificate), *_of_trust(store)],
        retention=ingest.retention(),
        replay_bytes=ingest.replay_bytes,
        storage_fault=fleet.storage_fault,
    )


def _of_http(certificate: HttpCertificate | None) -> list[Ending]:
    if certificate is None:
        return []
    try:
        left = certificate.days_left()
    except UsageError as error:
        return [Ending("certificate", HTTP, None, str(error))]
    fault = f"expires in {left:.1f} days: replace it by a renewed one" if left < ENDS_SOON_DAYS else ""
    return [Ending("certificate", HTTP, round(left, 2), fault)]


def _of_trust(store: MapStore) -> list[Ending]:
    try:
        found = trust_status(store)
    except StateError:  # an unsigned store
        return []
    except StoreError as error:
        return [Ending("signed list", "all", None, str(error))]
    certificates = [Ending("certificate", each.file, each.days_left, each.fault) for each in found.certificates]
    return certificates + [Ending("signed list", each.role, each.days_left, each.fault) for each in found.roles]
