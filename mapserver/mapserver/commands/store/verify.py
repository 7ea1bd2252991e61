"""`mapserver verify`: whether a store is whole."""

import typer

from mapserver.commands.options import Json, StoreFolder
from mapserver.commands.print_json import print_json

EXIT_STATUS_FAULTS = 3


def verify(
    store: StoreFolder,
    json: Json = False,
) -> None:
    """Check every hash and every reference of a store, and its database; ends with status 3 where something is wrong."""
    from mapserver.store import MapStore

    with MapStore.open(store) as maps:
        found = maps.verify()
    if json:
        print_json(found)
    else:
        typer.echo(f"{found.sites} sites, {found.versions} versions, {found.blobs} blobs of {found.blob_bytes} bytes")
        if found.orphans or found.leftovers:
            typer.echo(f"{found.orphans + found.leftovers} files that nothing mentions; `mapserver gc` removes them")
        for fault in found.faults:
            typer.echo(f"fault: {fault}")
        typer.echo("clean" if not found.faults else f"{len(found.faults)} faults; import the versions again or restore")
    if found.faults:
        raise typer.Exit(EXIT_STATUS_FAULTS)
