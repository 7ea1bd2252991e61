"""`mapserver import`: takes a version out of an export file."""

from pathlib import Path
from typing import Annotated

import typer

from mapserver.commands.actor_option import ActorName, Reason, acting


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File that `mapserver export` wrote.")],
    store: Annotated[Path, typer.Option(help="Folder of the map store; made if it is not there.")],
    actor: ActorName = None,
    reason: Reason = "",
) -> None:
    """Take the version in FILE into a store, as a draft of its site under its own number."""
    from mapserver.store import MapStore

    with MapStore.open(store, create=True) as maps:
        info = maps.import_version(file, actor=acting(actor, reason))
    typer.echo(f"site {info.site}: version {info.version} is in the store ({info.state})")
