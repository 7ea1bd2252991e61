"""What is an incident: alerts, drafts that were refused, recordings that are held or bad, and failures."""

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from fleetmap.errors import UsageError
from mapserver.fleet.alerts import AlertSettings, Incident, active_alerts, with_acts
from mapserver.fleet.fleet import Fleet
from mapserver.nightly.inbox import Inbox, contents, sites_of
from mapserver.serving.night_runs import SETTLE_S
from mapserver.store import FailureRow, MapStore

_FAILURE = re.compile("failure/([^/]+)/([0-9]{1,12})")


def of_failure(row: FailureRow) -> Incident:
    """Return a failure as an incident."""
    words = (
        f"{row.robot} failed: {row.cause.replace('_', ' ') or 'cause unknown'}{f', {row.where}' if row.where else ''}"
    )
    return Incident("failure", row.site, str(row.number), row.received_ns, words)


def of_drafts(store: MapStore, site: str) -> Iterator[Incident]:
    """Yield the drafts beyond the current version that the gate refused."""
    rows, verdicts = store.releases(site), store.last_verdicts(site)
    current = 0 if rows.current is None else rows.current.version
    for version, info in rows.versions.items():
        verdict = verdicts.get(version)
        if info.state == "draft" and version > current and verdict is not None and not verdict.accepted:
            words = f"draft {version} of {site} was refused: {'; '.join(verdict.reasons)}"
            yield Incident("draft", site, str(version), verdict.stamp_ns, words)


def of_inbox(inbox: Inbox) -> Iterator[Incident]:
    """Yield the recordings that are held or bad."""
    for box, entries in (("held", inbox.held), ("bad", inbox.bad)):
        for one in entries:
            words = f"{one.name} is {box}: {one.reason}"
            yield Incident("recording", inbox.site, f"{box}/{one.name}", one.since_ns, words)


def present(
    store: MapStore, fleet: Fleet, settings: AlertSettings, inbox: Path | None, site: str | None = None
) -> list[Incident]:
    """Return what there is now (of a site, and of the server), also if it is closed, and failures that somebody took on and nobody closed.

    inbox: the folder with an inbox for each site, None without one.
    """
    now_ns = store.now_ns()
    found = [
        alert for alert in active_alerts(store, fleet, settings, now_ns) if site is None or alert.site in ("", site)
    ]
    for name in (info.site for info in store.sites() if site in (None, info.site)):
        found += of_drafts(store, name)
    if inbox is not None:
        for name in (name for name in sites_of(inbox) if site in (None, name)):
            found += of_inbox(contents(inbox / name, SETTLE_S, now_ns))
    for incident, acts in store.incident_acts().items():
        named = _FAILURE.fullmatch(incident)
        if named and site in (None, named[1]) and not acts[-1].detail.startswith("closed"):
            with suppress(UsageError):  # it was removed, or its time is over
                failure = of_failure(store.fleet.failure(int(named[2])).failure)
                if acts[-1].stamp_ns >= failure.since_ns:  # else of another one of this number
                    found.append(failure)
    return with_acts(store, found)


def incidents(*of: Any) -> list[Incident]:
    """Return those of `present` that are not closed."""
    return [one for one in present(*of) if one.state != "closed"]


def find(incident: str, store: MapStore, *more: Any) -> Incident:
    """Return one of those that are present or any failure, by its id; UsageError for another one."""
    named = _FAILURE.fullmatch(incident)
    found = [of_failure(store.fleet.failure(int(named[2])).failure)] if named else present(store, *more)
    for one in found:
        if one.id == incident:
            return one
    how = "`mapserver incidents list` shows all, with --inbox DIR recordings too"
    raise UsageError(f"there is no incident {incident[:200]!r} now; {how}")
