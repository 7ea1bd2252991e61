"""`mapserver publish`: a draft becomes the current version of its site."""

from pathlib import Path
from typing import Annotated

import typer


def publish(
    site: Annotated[str, typer.Option(help="Name of the site.")],
    store: Annotated[Path, typer.Option(help="Folder of the map store.")],
    version: Annotated[
        int | None, typer.Option(min=1, help="The draft to publish; the newest one if left out.")
    ] = None,
) -> None:
    """Make a draft the current version of its site; ends with status 4 where the gate refuses it."""
    from mapserver.store import MapStore

    with MapStore.open(store) as maps:
        published = maps.publish(site, version)
        info = maps.version(site, published)
    sizes = f"{info.tiles} tiles, {info.landmarks} landmarks, {info.map_bytes} bytes"
    typer.echo(f"site {site}: version {published} is current ({sizes})")
