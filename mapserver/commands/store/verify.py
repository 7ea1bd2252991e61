"""`mapserver verify`: integrity of a store."""

import shlex

import typer

from mapserver.commands.options import Json, StoreFolder, open_store, print_json

EXIT_STATUS_FAULTS = 3


def verify(store: StoreFolder, json: Json = False) -> None:
    """Check every hash and every reference of a store, and its database; status 3 if there is a fault."""
    with open_store(store, read_only=True) as maps:
        found = maps.verify()
    if json:
        print_json(found)
    else:
        typer.echo(f"{found.sites} sites, {found.versions} versions, {found.blobs} blobs of {found.blob_bytes} bytes")
        if found.orphans or found.leftovers:
            typer.echo(
                f"{found.orphans + found.leftovers} unreferenced files; `mapserver gc --store {shlex.quote(str(store))}` removes them"
            )
        if found.open_to_others:
            typer.echo(f"other users of this machine may read the store; `chmod -R go= {store}` ends that")
        for fault in found.faults:
            typer.echo(f"fault: {fault}")
        typer.echo("clean" if not found.faults else f"{len(found.faults)} faults; import the versions again or restore")
    if found.faults:
        raise typer.Exit(EXIT_STATUS_FAULTS)
