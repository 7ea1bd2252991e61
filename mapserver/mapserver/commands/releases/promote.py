"""`mapserver promote`: a version becomes current, for all robots at once or for some of them first."""

from pathlib import Path
from typing import Annotated

import typer

from mapserver.commands.actor_option import ActorName, Reason, acting
from mapserver.commands.config_option import ConfigFile, config_path


def promote(
    context: typer.Context,
    version: Annotated[int, typer.Argument(min=1, metavar="VERSION", help="The version; `versions` lists them.")],
    site: Annotated[str, typer.Option(help="Name of the site.")],
    store: Annotated[Path, typer.Option(help="Folder of the map store.")],
    canary: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Let such a share of the robots try it first, such as 5%.")
    ] = None,
    actor: ActorName = None,
    reason: Reason = "",
    config: ConfigFile = None,
) -> None:
    """Make VERSION, published before, the current version of its site.

    With --canary some robots run it first (a draft goes through the gate before); the server then promotes it or takes it back.
    """
    from mapserver import releases
    from mapserver.config import read_config
    from mapserver.store import MapStore

    share = None if canary is None else _share(canary)
    gate = read_config(config_path(context)).gate
    with MapStore.open(store) as maps:
        if share is None:
            releases.promote(maps, site, version, actor=acting(actor, reason))
            typer.echo(f"site {site}: version {version} is current")
            return
        begun = releases.start_canary(maps, site, version, share, actor=acting(actor, reason), gate=gate)
    typer.echo(
        f"site {site}: {share:g} of the robots try version {version}, the others stay on {begun.base_version}; "
        "`mapserver serve` judges it, `rollback` takes it back"
    )


def _share(text: str) -> float:
    from fleetmap.errors import UsageError

    try:
        share = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        share = 0.0
    if not 0 < share < 1:
        raise UsageError(f"--canary {text!r}: write a share of the robots between 0 and 1, such as 5% or 0.05")
    return share
