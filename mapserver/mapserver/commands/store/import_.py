"""`mapserver import`: a version from an export file."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import expand_options
from mapserver.commands.options import ActorOptions, NewStoreFolder


@expand_options
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File that `mapserver export` wrote.")],
    store: NewStoreFolder,
    by: ActorOptions,
    root: Annotated[
        Path | None,
        typer.Option(
            metavar="1.root.json", help="The sender's root: refuse what the lists in FILE.trust do not admit."
        ),
    ] = None,
) -> None:
    """Take the version in FILE into a store, as a draft of its site under its own number."""
    from mapserver.store import MapStore
    from mapserver.trust.carried_lists import check_carried

    if root is not None:
        check_carried(file, root)
    with MapStore.open(store, create=True) as maps:
        info = maps.import_version(file, actor=by.named())
    typer.echo(f"site {info.site}: version {info.version} is in the store ({info.state})")
