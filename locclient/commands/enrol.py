"""`locclient enrol`: a robot gets its identity from a bundle."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.errors import UsageError, disk_errors
from locclient.commands.options import IdentityFolder

_MAX_BYTES = 1 << 20


def enrol(
    bundle: Annotated[Path, typer.Argument(metavar="BUNDLE", help="ROBOT.fleetmap, from `mapserver robots enrol`.")],
    identity: IdentityFolder = None,
) -> None:
    """Make this robot's own key, and get a certificate for it. `run`, `replay` and `check` then need no server and no root."""
    from locclient.identity import RobotIdentity, identity_folder

    with disk_errors(f"{bundle} cannot be read", "check the path", UsageError):
        if bundle.stat().st_size > _MAX_BYTES:
            raise UsageError(f"{bundle} has {bundle.stat().st_size} bytes and is no enrolment bundle")
        data = bundle.read_bytes()
    made = RobotIdentity.enrol(identity_folder(identity), data)
    about = made.certificate()
    typer.echo(f"enrolled as {made.who.robot} of site {made.who.site} at {made.who.endpoint}")
    typer.echo(f"certificate {about.name} until {about.ends:%Y-%m-%d}, in {made.folder}")
    typer.echo(f"{bundle} is used and worth nothing now; remove it")
