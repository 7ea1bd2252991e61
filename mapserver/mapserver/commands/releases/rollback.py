"""`mapserver rollback`: back to the version that was current before."""

import typer

from fleetmap.cli_options import expand_options
from mapserver.commands.options import ActorOptions, SiteName, StoreFolder


@expand_options
def rollback(site: SiteName, store: StoreFolder, by: ActorOptions) -> None:
    """Make the previous version current again; the current one retires."""
    from mapserver import releases
    from mapserver.store import MapStore

    with MapStore.open(store) as maps:
        version = releases.roll_back(maps, site, actor=by.named())
    typer.echo(f"site {site}: version {version} is current again")
