"""`mapserver rollback`: back to the version that was current before."""

from pathlib import Path
from typing import Annotated

import typer

from mapserver.commands.actor_option import ActorName, Reason, acting


def rollback(
    site: Annotated[str, typer.Option(help="Name of the site.")],
    store: Annotated[Path, typer.Option(help="Folder of the map store.")],
    actor: ActorName = None,
    reason: Reason = "",
) -> None:
    """Make the version current that was so before the current one, which retires."""
    from mapserver import releases
    from mapserver.store import MapStore

    with MapStore.open(store) as maps:
        version = releases.roll_back(maps, site, actor=acting(actor, reason))
    typer.echo(f"site {site}: version {version} is current again")
