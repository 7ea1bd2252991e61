"""`mapserver promote`: a version becomes current, for all robots at once or for some of them first."""

from typing import Annotated

import typer

from fleetmap.cli_options import ConfigFile, expand_options, settings_of
from mapserver.commands.options import ActorOptions, SiteOptions


@expand_options
def promote(
    context: typer.Context,
    version: Annotated[int, typer.Argument(min=1, metavar="VERSION", help="The version; `versions` lists them.")],
    where: SiteOptions,
    by: ActorOptions,
    canary: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Try it on this share of the robots first, such as 5%.")
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Make VERSION, published before, the current version of its site.

    With --canary some robots run it first (a draft goes through the gate before); the server then promotes it or rolls it back.
    """
    from mapserver import releases
    from mapserver.store import MapStore

    share = None if canary is None else _share(canary)
    gate = settings_of(context).gate
    with MapStore.open(where.store) as maps:
        if share is None:
            releases.promote(maps, where.site, version, actor=by.named())
            typer.echo(f"site {where.site}: version {version} is current")
            return
        begun = releases.start_canary(maps, where.site, version, share, actor=by.named(), gate=gate)
    typer.echo(
        f"site {where.site}: {share:g} of the robots try version {version}, the others stay on {begun.base_version}; "
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
