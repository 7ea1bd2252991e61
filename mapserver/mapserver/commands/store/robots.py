"""`mapserver robots`: the robots that a store knows."""

from typing import Annotated

import typer

from fleetmap.cli_options import Group, expand_options
from fleetmap.errors import UsageError
from mapserver.commands.options import ActorOptions, SiteOptions


@expand_options
def remove(
    robots: Annotated[list[str], typer.Argument(metavar="ROBOT...", help="Names of robots.")],
    where: SiteOptions,
    by: ActorOptions,
) -> None:
    """Forget robots: they no longer stand in lists or keep versions from `gc`. What was counted of them stays.

    A server that runs forgets them within seconds; a robot that speaks again is known again.
    """
    from mapserver.store import MapStore

    with MapStore.open(where.store) as maps:
        removed = maps.remove_robots(where.site, robots, actor=by.named())
    for robot in removed:
        typer.echo(f"site {where.site}: robot {robot} is removed")
    missing = [robot for robot in robots if robot not in removed]
    if missing:
        raise UsageError(f"site {where.site} knows no robot {', '.join(missing)}; its others of these are removed")


ROBOTS = Group("The robots that a store knows.", {"remove": remove})
