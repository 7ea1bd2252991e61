"""`mapserver promote`: a version that was published before becomes current again."""

from pathlib import Path
from typing import Annotated

import typer

from mapserver.commands.actor_option import ActorName, Reason, acting


def promote(
    version: Annotated[int, typer.Argument(min=1, metavar="VERSION", help="The version; `versions` lists them.")],
    site: Annotated[str, typer.Option(help="Name of the site.")],
    store: Annotated[Path, typer.Option(help="Folder of the map store.")],
    actor: ActorName = None,
    reason: Reason = "",
) -> None:
    """Make VERSION, published before, the current version of its site."""
    from mapserver.store import MapStore

    with MapStore.open(store) as maps:
        maps.promote(site, version, actor=acting(actor, reason))
    typer.echo(f"site {site}: version {version} is current")
