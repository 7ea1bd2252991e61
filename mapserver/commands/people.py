"""`mapserver robots` and `operators`: the robots and the accounts of a store, beside the operations on them."""

from datetime import UTC, datetime
from typing import Annotated

import typer

from fleetmap.cli_options import Group
from mapserver.commands.options import Json, StoreFolder, open_store, print_json, print_table


def list_robots(
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


def list_operators(store: StoreFolder, json: Json = False) -> None:
    """List operators and programs with their roles, sessions and tokens."""
    from mapserver.operators.operators import Operators

    with open_store(store, read_only=True) as maps:
        found = Operators(maps).all()
    if json:
        shown = ("name", "role", "is_disabled", "sessions", "tokens")
        print_json([{name: getattr(row, name) for name in shown} for row in found])
        return
    rows = ((r.name, r.role, r.sessions, r.tokens, "disabled" if r.is_disabled else "") for r in found)
    print_table(("name", "role", "sessions", "tokens", ""), rows)


ROBOTS = Group("Known robots of a store, and those enrolled at its server.", {"list": list_robots})
OPERATORS = Group("Accounts of operators and programs.", {"list": list_operators})
