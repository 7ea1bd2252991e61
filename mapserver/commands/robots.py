"""`mapserver robots`: the robots known to a store."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import Group, expand_options
from fleetmap.errors import UsageError, disk_errors
from mapserver.commands.options import ActorOptions, Json, SiteOptions, StoreFolder, open_store, print_json, print_table

Robots = Annotated[list[str], typer.Argument(metavar="ROBOT...", help="Names of robots.")]


@expand_options
def remove(robots: Robots, where: SiteOptions, by: ActorOptions) -> None:
    """Remove robots from lists; `gc` need not keep their versions any more. Their past counts stay.

    A running server removes them within seconds; a robot that reports again is added again.
    """
    with open_store(where.store) as maps:
        removed = maps.remove_robots(where.site, robots, actor=by.named())
    _tell(robots, removed, where.site, "removed", "knows no robot")


@expand_options
def enrol(
    robots: Robots,
    where: SiteOptions,
    by: ActorOptions,
    endpoint: Annotated[
        str | None,
        typer.Option(metavar="ENDPOINT", help="Endpoint of the server; default: its certificate's first name."),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the bundles ROBOT.fleetmap.")] = Path(),
) -> None:
    """Allow robots on the bus: writes one bundle per robot for `locclient enrol`, to be used once within a day.

    A bundle is secret until it is used: transfer it on a USB stick or over SSH.
    """
    from fleetmap.bus.endpoints import check_endpoint
    from fleetmap.files import write_atomically
    from mapserver.trust.enrolment import LISTENING, RobotRegister

    with open_store(where.store) as maps:
        register = RobotRegister(maps)
        reached = check_endpoint(endpoint) if endpoint is not None else register.default_endpoint(LISTENING)
        with disk_errors(f"{out} cannot be written", "name another folder by --out", UsageError):
            out.mkdir(parents=True, exist_ok=True)
            for robot, bundle in register.enrol(where.site, robots, reached, actor=by.named()).items():
                path = out / f"{robot}.fleetmap"
                write_atomically(path, [bundle])
                typer.echo(f"{path}: for robot {robot} of site {where.site} at {reached}, within 24 h")
        if where.site not in {info.site for info in maps.sites()}:
            typer.echo(f"note: the store has no map of site {where.site} yet", err=True)


@expand_options
def revoke(robots: Robots, where: SiteOptions, by: ActorOptions) -> None:
    """Remove robots, such as stolen ones, from the bus at once; a running server follows within two seconds."""
    from mapserver.trust.enrolment import RobotRegister

    with open_store(where.store) as maps:
        gone = RobotRegister(maps).revoke(where.site, robots, actor=by.named())
    _tell(robots, gone, where.site, "revoked", "has not enrolled")


def _tell(asked: list[str], gone: list[str], site: str, done: str, fault: str) -> None:
    for robot in gone:
        typer.echo(f"site {site}: robot {robot} is {done}")
    if missing := [robot for robot in asked if robot not in gone]:
        raise UsageError(f"site {site} {fault} {', '.join(missing)}; the other named robots are {done}")


def list_(
    store: StoreFolder,
    site: Annotated[str | None, typer.Option(help="Name of the site; default: all sites.")] = None,
    json: Json = False,
) -> None:
    """Show the enrolled robots, the names in their certificates, and the days until they expire."""
    from mapserver.trust.enrolment import RobotRegister

    with open_store(store, read_only=True) as maps:
        found = [entry.shown(maps.now_ns()) for entry in RobotRegister(maps).robots(site)]
    if json:
        print_json(found)
        return
    enrolled = [f"{datetime.fromtimestamp(row.enrolled_ns / 1e9, UTC):%Y-%m-%d %H:%M}" for row in found]
    rows = ((r.site, r.robot, r.certificate, at, r.state) for r, at in zip(found, enrolled, strict=True))
    print_table(("site", "robot", "certificate", "enrolled", "state"), rows)


ROBOTS = Group(
    "Known robots of a store, and those enrolled at its server.",
    {"enrol": enrol, "revoke": revoke, "list": list_, "remove": remove},
)
