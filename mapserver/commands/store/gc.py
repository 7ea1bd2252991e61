"""`mapserver gc`: removal of unused versions and files from a store."""

from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import expand_options
from fleetmap.errors import StoreError
from mapserver.commands.options import ActorOptions, Json, StoreFolder, open_store, print_json

if TYPE_CHECKING:
    from mapserver.store.garbage_collection import Garbage


@expand_options
def gc(
    *,
    store: StoreFolder,
    keep_versions: Annotated[int, typer.Option(min=0, help="Published versions of a site to keep.")] = 5,
    keep_drafts: Annotated[int, typer.Option(min=0, help="Drafts of a site to keep.")] = 3,
    keep_days: Annotated[float, typer.Option(min=0, help="Days to keep retired versions and old drafts.")] = 7.0,
    robot_days: Annotated[
        float, typer.Option(min=0, help="Days for which a silent robot still counts as using its version.")
    ] = 30.0,
    by: ActorOptions,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what would be removed; remove nothing.")] = False,
    json: Json = False,
) -> None:
    """Remove drafts and retired versions beyond retention, and unreferenced files.

    Current versions, targets of a rollback and versions that robots run are always kept.
    """
    from mapserver.store import Retention
    from mapserver.store.database import format_of
    from mapserver.store.files import keep_reserve, release_reserve
    from mapserver.store.schema import FORMAT, LAST_UNNAMED

    retention = Retention(keep_versions, keep_drafts, keep_days, robot_days)

    def collect() -> "Garbage":
        with open_store(store, read_only=dry_run) as maps:
            return maps.collect_garbage(retention, dry_run=dry_run, actor=by.named())

    try:
        garbage = collect()
    except StoreError:
        # A store of another format is refused for that, and keeps its reserve.
        is_ours = LAST_UNNAMED <= format_of(store / "store.sqlite3") <= FORMAT
        if dry_run or not is_ours or not release_reserve(store):
            raise
        try:
            garbage = collect()  # the disk was full
        finally:
            keep_reserve(store)
    if json:
        print_json(garbage)
        return
    would = "would be " if dry_run else ""
    for word, versions in (("retired", garbage.retired), ("removed", garbage.removed)):
        for site, version in versions:
            typer.echo(f"site {site}: version {version} {would}{word}")
    typer.echo(f"{garbage.files} files {would}removed, {garbage.freed_bytes} bytes {would}freed")
