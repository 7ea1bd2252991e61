"""`mapserver verify`, `gc`, `attach`, `export`, `import` and `audit`: the store as a whole, and versions as files."""

import shlex
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Context, Exit, Option, echo

from fleetmap.cli_options import settings_of
from fleetmap.errors import BusyError, StoreError, UsageError
from mapserver.commands import options

if TYPE_CHECKING:
    from mapserver.store import AuditLine, MapStore
    from mapserver.store.upkeep import Garbage, StoreFindings

EXIT_STATUS_FAULTS = 3
DryRun = Annotated[bool, Option("--dry-run", help="Print what would be removed; remove nothing.")]


def verify(store: options.StoreFolder, json: options.Json = False) -> None:
    """Check every hash and every reference of a store, and its database; status 3 if there is a fault."""
    with options.open_store(store, read_only=True) as maps:
        found = maps.verify()
    options.print_result(found, _findings(store, found), json=json)
    if found.faults:
        raise Exit(EXIT_STATUS_FAULTS)


def _findings(store: Path, found: "StoreFindings") -> Iterator[str]:
    yield f"{found.sites} sites, {found.versions} versions, {found.blobs} blobs of {found.blob_bytes} bytes"
    if unreferenced := found.orphans + found.leftovers:
        yield f"{unreferenced} unreferenced files; `mapserver gc --store {shlex.quote(str(store))}` removes them"
    if found.open_to_others:
        yield f"other users of this machine can read the store; `chmod -R go= {store}` prevents that"
    yield from (f"fault: {fault}" for fault in found.faults)
    yield "clean" if not found.faults else f"{len(found.faults)} faults; import the versions again or restore"


def gc(
    *,
    store: options.StoreFolder,
    keep_versions: Annotated[int, Option(min=0, help="Published versions of a site to keep.")] = 5,
    keep_drafts: Annotated[int, Option(min=0, help="Drafts of a site to keep.")] = 3,
    keep_days: Annotated[float, Option(min=0, help="Days to keep retired versions and old drafts.")] = 7.0,
    robot_days: Annotated[
        float, Option(min=0, help="Days for which a silent robot still counts as using its version.")
    ] = 30.0,
    by: options.ActorOptions,
    dry_run: DryRun = False,
    json: options.Json = False,
) -> None:
    """Remove drafts and retired versions beyond retention, and unreferenced files.

    Current versions, targets of a rollback and versions that robots run are always kept.
    """
    from mapserver.store import Retention
    from mapserver.store.database import format_of
    from mapserver.store.files import keep_reserve, release_reserve
    from mapserver.store.schema import FORMAT

    retention = Retention(keep_versions, keep_drafts, keep_days, robot_days)

    def collect() -> "Garbage":
        with options.open_store(store, read_only=dry_run) as maps:
            return maps.collect_garbage(retention, dry_run=dry_run, actor=by.named())

    try:
        garbage = collect()
    except StoreError:
        # A store of another format raises its own error, and its disk reserve is kept.
        is_ours = 0 < format_of(store / "store.sqlite3") <= FORMAT
        if dry_run or not is_ours or not release_reserve(store):
            raise
        try:
            garbage = collect()  # the disk was full
        finally:
            keep_reserve(store)
    would = "would be " if dry_run else ""
    words = [f"site {site}: version {version} {would}retired" for site, version in garbage.retired]
    words += [f"site {site}: version {version} {would}removed" for site, version in garbage.removed]
    words.append(f"{garbage.files} files {would}removed, {garbage.freed_bytes} bytes {would}freed")
    options.print_result(garbage, words, json=json)


def retention(
    context: Context,
    *,
    store: options.StoreFolder,
    inbox: Annotated[
        Path | None, Option(metavar="DIR", help="An inbox, or the folder with an inbox for each site.")
    ] = None,
    dry_run: DryRun = False,
    json: options.Json = False,
) -> None:
    """Remove reports, pictures and recordings that are older than their periods, as the nightly job does.

    Versions of maps are removed by `gc`.
    """
    from fleetmap.mapformat.names import is_name
    from mapserver.nightly.inbox import apply_retention, sites_of

    inboxes = [] if inbox is None else [inbox, *(inbox / site for site in sites_of(inbox))]
    with options.open_store(store) as maps, ExitStack() as locks:
        free = [each for each in inboxes if not is_name(each.name) or _is_free(maps, each.name, locks)]
        removed = apply_retention(maps, settings_of(context).ingest.retention(), free, dry_run=dry_run)
    for each in sorted({*inboxes} - {*free}):
        echo(f"{each}: a night reads its recordings; it removed what was old at its start", err=True)
    would = "would be " if dry_run else ""
    options.print_result(removed, (f"{name}: {count} {would}removed" for name, count in removed.items()), json=json)


def _is_free(maps: "MapStore", site: str, locks: ExitStack) -> bool:
    """Keep nights of a site away from its recordings until `locks` end; False if one runs."""
    from mapserver.drafting.job_lock import only_one

    try:
        locks.enter_context(only_one(maps, site))
    except BusyError:
        return False
    return True


def export(
    file: Annotated[Path, Argument(metavar="FILE", help="File to write; replaced if it exists.")],
    site: options.SiteName,
    store: options.StoreFolder,
    version: Annotated[int | None, Option(min=1, help="Version; default: the current one.")] = None,
    without_archive: Annotated[
        bool, Option("--without-archive", help="Leave out data needed only by later surveys.")
    ] = False,
) -> None:
    """Write a version into FILE; `mapserver import` reads it into another store."""
    options.check_output("FILE", file)
    with options.open_store(store, read_only=True) as maps:
        version = options.version_named(maps, site, version)
        size = maps.export_version(site, version, file, archive=not without_archive)
    echo(f"site {site}: version {version} is in {file} ({size} bytes)")


def import_(
    file: Annotated[Path, Argument(metavar="FILE", help="File written by `mapserver export`.")],
    store: options.NewStoreFolder,
    by: options.ActorOptions,
) -> None:
    """Import the version in FILE into a store, as a draft of its site with the same number."""
    with options.open_store(store, create=True) as maps:
        info = maps.import_version(file, actor=by.named())
    echo(f"site {info.site}: version {info.version} is in the store ({info.state})")


def audit(
    store: options.StoreFolder,
    verify: Annotated[bool, Option("--verify", help="Check the hash chain; status 3 for a fault.")] = False,
    last: Annotated[int, Option(min=1, help="Number of lines to print.")] = 50,
    person: Annotated[str | None, Option(metavar="NAME", help="Only what this person did.")] = None,
    site: Annotated[str | None, Option(help="Only what was done to this site.")] = None,
    kind: Annotated[str | None, Option(metavar="KIND", help="Only kinds that begin so.")] = None,
    json: options.Json = False,
) -> None:
    """Print the log of a store: releases, sign-ins, operators, refusals; the last lines, oldest first."""
    from mapserver.store import chain_faults

    with options.open_store(store, read_only=True) as maps:
        lines = (maps.log() if verify else maps.log(site=site, person=person, kind=kind, limit=last))[::-1]
    if not verify:
        options.print_result(lines, map(_words, lines), json=json)
        return
    faults = chain_faults(lines)
    summary = f"{len(lines)} lines, {f'{len(faults)} faults' if faults else 'clean'}"
    told = [*(f"fault: {fault}" for fault in faults), summary]
    options.print_result({"lines": len(lines), "faults": faults}, told, json=json)
    if faults:
        raise Exit(EXIT_STATUS_FAULTS)


def _words(line: "AuditLine") -> str:
    """Return an entry as one line; text from outside is quoted."""
    when = datetime.fromtimestamp(line.stamp_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")
    proved = " (signed in)" if line.operator else ""
    parts = [f"{line.id} {when} {line.kind}", line.site and f"site {line.site}", repr(line.detail)]
    parts += [line.actor and f"by {line.actor!r}{proved}", line.address and f"from {line.address!r}"]
    parts += [line.reason and f"because {line.reason!r}"]
    return ", ".join(part for part in parts if part)


def attach(
    store: options.NewStoreFolder,
    content: Annotated[str | None, Option(metavar="URL", help="Object store for tiles, archives and pictures.")] = None,
    database: Annotated[str | None, Option(metavar="URL", help="PostgreSQL database for everything else.")] = None,
) -> None:
    """Move a store out of its folder, or let a new folder share one that was moved; stop the server and the nights first."""
    from mapserver.store import MapStore
    from mapserver.store.places import Places

    if content is None and database is None:
        raise UsageError("name --content, --database or both")
    with options.shown_progress("blobs") as progress:
        copied = MapStore.attach(store, Places(content, database), progress)
    echo(
        f"{store} uses {content or 'its content'} and {'the named' if database else 'its'} database; {copied} bytes of content were copied"
    )
