"""Periods of what a server keeps, enforced: reports, pictures and recordings of failures, pictures and recordings of surveys."""

from collections.abc import Iterable
from pathlib import Path

from mapserver.nightly.inbox import remove_old
from mapserver.store import FleetRetention, MapStore


def apply_retention(
    maps: MapStore, retention: FleetRetention, inboxes: Iterable[Path], *, dry_run: bool = False
) -> dict[str, int]:
    """Remove what is older than its period; return by name how much that is. StoreError on a disk error.

    dry_run: remove nothing.
    """
    removed = maps.fleet.expired(retention)
    if not dry_run:
        maps.fleet.prune(retention)
    removed["pictures of surveys"] = maps.remove_survey_pictures(retention.survey_picture_days, dry_run=dry_run)
    days, now_ns = retention.recording_days, maps.now_ns()
    removed["recordings of surveys"] = sum(remove_old(inbox, days, now_ns, dry_run=dry_run) for inbox in inboxes)
    return removed
