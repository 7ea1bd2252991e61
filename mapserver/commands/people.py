"""`mapserver robots`, `operators` and `incidents`: the robots, accounts and incidents of a store, beside the operations on them."""

from datetime import UTC, datetime
from typing import Annotated

from typer import Context, Option

from fleetmap.cli_options import Group, settings_of
from mapserver.api.operations.incidents import InboxFolder
from mapserver.commands.options import Json, StoreFolder, open_store, print_result, table

Site = Annotated[str | None, Option(help="Name of the site; default: all sites.")]


def list_robots(store: StoreFolder, site: Site = None, json: Json = False) -> None:
    """Show the enrolled robots, the names in their certificates, and the days until they expire."""
    from mapserver.trust.enrolment import RobotRegister

    with open_store(store, read_only=True) as maps:
        found = [entry.shown(maps.now_ns()) for entry in RobotRegister(maps).robots(site)]
    enrolled = [f"{datetime.fromtimestamp(row.enrolled_ns / 1e9, UTC):%Y-%m-%d %H:%M}" for row in found]
    rows = ((r.site, r.robot, r.certificate, at, r.state) for r, at in zip(found, enrolled, strict=True))
    print_result(found, [table(("site", "robot", "certificate", "enrolled", "state"), rows)], json=json)


def list_operators(store: StoreFolder, json: Json = False) -> None:
    """List operators and programs with their roles, sessions and tokens."""
    from mapserver.operators.operators import Operators

    with open_store(store, read_only=True) as maps:
        found = Operators(maps).all()
    shown = [{key: getattr(row, key) for key in ("name", "role", "is_disabled", "sessions", "tokens")} for row in found]
    rows = ((r.name, r.role, r.sessions, r.tokens, "disabled" if r.is_disabled else "") for r in found)
    print_result(shown, [table(("name", "role", "sessions", "tokens", ""), rows)], json=json)


def list_incidents(
    context: Context, store: StoreFolder, site: Site = None, inbox: InboxFolder = None, json: Json = False
) -> None:
    """List alerts, refused drafts, recordings that are held or bad, and failures in work, with their state and who has them."""
    from mapserver.api.incidents import incidents
    from mapserver.fleet.fleet import Fleet

    with open_store(store, read_only=True) as maps:
        found = incidents(maps, Fleet(maps), settings_of(context).alerts, inbox, site)
    rows = ((one.id, one.state, one.assignee, one.words) for one in found)
    print_result(found, [table(("incident", "state", "who", "what"), rows)], json=json)


ROBOTS = Group("Known robots of a store, and those enrolled at its server.", {"list": list_robots})
INCIDENTS = Group("Alerts, held recordings, refused drafts and failures in work.", {"list": list_incidents})
OPERATORS = Group("Accounts of operators and programs.", {"list": list_operators})
