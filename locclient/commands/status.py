"""`locclient status`: what the robot's daemon last said of itself."""

from pathlib import Path
from typing import Annotated

import typer


def status(
    folder: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="The daemon's $RUNTIME_DIRECTORY; default: ours, or /run/fleetmap."),
    ] = None,
) -> None:
    """Print what the running daemon last said; status 3 if it has not said anything for ten seconds."""
    from locclient.daemon.service_manager import last_status, runtime_folder

    typer.echo(last_status(folder or runtime_folder() or Path("/run/fleetmap")))
