"""`mapserver backup`, `restore` and `backups`: copies of a store in a folder or an object store."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option

from mapserver.commands.options import ActorOptions, Json, StoreFolder, open_store, print_result, shown_progress
from mapserver.commands.store import EXIT_STATUS_FAULTS

if TYPE_CHECKING:
    from mapserver.plugins.backups.restore import RestoreReport

Where = Annotated[str, Argument(metavar="TARGET", help="Folder, or s3://BUCKET/PREFIX; for one store alone.")]


def backup(
    target: Where,
    store: StoreFolder,
    recipient: Annotated[
        str | None,
        Option(
            metavar="AGE1", help="Public key of age for which the store's keys are encrypted; default: without keys."
        ),
    ] = None,
    keep: Annotated[int, Option(min=1, help="Number of snapshots to keep.")] = 30,
    json: Json = False,
) -> None:
    """Back up a store, also while it is served; only what changed since the last time is copied."""
    from mapserver.plugins.backups.backup import back_up, recipient_of
    from mapserver.plugins.backups.snapshots import BackupTarget

    key = recipient_of(recipient)
    with open_store(store, read_only=True) as maps, shown_progress("blobs") as progress:
        done = back_up(maps, BackupTarget(target, create=True), recipient=key, keep=keep, progress=progress)
    keys = "keys encrypted" if done.has_keys else "without keys (--recipient)"
    sizes = f"{done.bytes} bytes, {done.uploaded_bytes} of them copied"
    lost = "is lost or damaged in the store, and in no backup; `mapserver verify` says of what"
    lines = [f"snapshot {done.snapshot}: {sizes}; {keys}; {len(done.removed)} older ones removed"]
    print_result(done, [*lines, *(f"fault: blob {address} {lost}" for address in done.missing)], json=json)
    if done.missing:
        raise Exit(EXIT_STATUS_FAULTS)


def restore(
    target: Where,
    *,
    store: Annotated[Path, Option(help="Folder of the new store; it must not exist, or be empty.")],
    snapshot: Annotated[
        str | None, Option(metavar="TIME", help="Snapshot, as `mapserver backups` lists them; default: the last.")
    ] = None,
    identity: Annotated[Path | None, Option(metavar="FILE", help="Private key of age, for the store's keys.")] = None,
    by: ActorOptions,
    json: Json = False,
) -> None:
    """Make a store of a backup. Robots then send again what the lost server had acknowledged in the last week."""
    from mapserver.plugins.backups.restore import identities_of
    from mapserver.plugins.backups.restore import restore as restored
    from mapserver.plugins.backups.snapshots import BackupTarget

    identities = identities_of(identity)
    with shown_progress("blobs") as progress:
        done = restored(
            BackupTarget(target), store, by.named(), name=snapshot, identities=identities, progress=progress
        )
    print_result(done, _restored(done, store), json=json)


def _restored(done: "RestoreReport", store: Path) -> Iterator[str]:
    counts = f"{done.versions} versions of {done.sites} sites, {done.robots} enrolled robots, {done.people} people and programs"
    rotate = f"`mapserver trust rotate online --key ROOT --store {store}`"
    yield f"{store} holds snapshot {done.snapshot}: {counts}, {len(done.keys)} key files"
    if "server.pem" in done.keys and not done.robots:
        yield f"robots are enrolled again by `mapserver robots enrol ROBOT --site SITE --store {store}`"
    if done.lists == "ahead":
        words = "the root key is elsewhere: if sites or keys were added after the backup, robots refuse the lists until"
        yield f"{words} {rotate} has run twice"
    elif done.lists == "old":
        words = "the signed lists are those of the backup, and robots that know later ones refuse them: restore with --identity"
        yield f"{words}, or put the keys into {store / 'keys'} and run {rotate} twice"
    yield from (f"blob {address} was lost or damaged already when the backup was made" for address in done.missing)


def backups(
    target: Where,
    verify: Annotated[bool, Option("--verify", help="Read every byte; status 3 for a fault.")] = False,
    json: Json = False,
) -> None:
    """List the snapshots of a backup."""
    from mapserver.plugins.backups.restore import verify as verified
    from mapserver.plugins.backups.snapshots import BackupTarget

    where = BackupTarget(target)
    if not verify:
        names = where.snapshots()
        print_result(names, names or ["no snapshots"], json=json)
        return
    with shown_progress("objects") as progress:
        found = verified(where, progress)
    lines = [f"{found.snapshots} snapshots, {found.objects} objects of {found.bytes} bytes"]
    lines += [f"fault: {fault}" for fault in found.faults]
    print_result(found, [*lines, f"{len(found.faults)} faults" if found.faults else "clean"], json=json)
    if found.faults:
        raise Exit(EXIT_STATUS_FAULTS)
