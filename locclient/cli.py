"""The command `locclient`. Heavy imports happen inside the commands, after their arguments are checked."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Context, Option, echo

from fleetmap.cli_exit import run_cli
from fleetmap.cli_options import Commands, Options, Version, make_app
from fleetmap.errors import UsageError, disk_errors
from locclient.replay_command import IdentityFolder, Insecure, replay

if TYPE_CHECKING:
    from locclient.config import LocclientConfig

_MAX_BUNDLE_BYTES = 1 << 20


def enrol(
    bundle: Annotated[Path, Argument(metavar="BUNDLE", help="ROBOT.fleetmap, from `mapserver robots enrol`.")],
    identity: IdentityFolder = None,
) -> None:
    """Create this robot's key and obtain a certificate for it. `run`, `replay` and `check` then need neither `server` nor `root`."""
    from locclient.identity import RobotIdentity, identity_folder

    with disk_errors(f"{bundle} cannot be read", "check the path", UsageError), bundle.open("rb") as file:
        data = file.read(_MAX_BUNDLE_BYTES + 1)
    if len(data) > _MAX_BUNDLE_BYTES:
        raise UsageError(f"{bundle} has more than {_MAX_BUNDLE_BYTES} bytes and is not an enrolment bundle")
    made = RobotIdentity.enrol(identity_folder(identity), data)
    about = made.certificate()
    echo(f"enrolled as {made.who.robot} of site {made.who.site} at {made.who.endpoint}")
    echo(f"certificate {about.name} until {about.ends:%Y-%m-%d}, in {made.folder}")
    echo(f"{bundle} is used and no longer valid; remove it")


def run(
    context: Context,
    config: Annotated[Path, Option(help="TOML file with the robot, its sensors, map and outputs.")],
    insecure: Insecure = False,
    verbose: Annotated[
        bool, Option("--verbose", help="Log changes of status, versions, drops and deliveries too.")
    ] = False,
) -> None:
    """Localize a robot from its live sensors; ends with status 0 on SIGTERM or SIGINT, or with its recording."""
    import logging
    import signal

    from fleetmap.log_lines import log_to_stderr

    log_to_stderr(logging.INFO if verbose else logging.WARNING, "%(levelname)s %(name)s: %(message)s")
    from locclient.config import with_insecure
    from locclient.daemon.daemon import daemon_parts
    from locclient.daemon.runtime import Runtime
    from locclient.daemon.service_manager import ServiceManager

    settings = with_insecure(context.obj(config)[0], insecure=insecure)
    with daemon_parts(settings) as parts:
        runtime = Runtime(parts, ServiceManager())
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: runtime.stop())
        echo(f"ready: {parts.profile.robot} at {parts.profile.site}, source {settings.source.kind}")
        runtime.run()


def status(
    folder: Annotated[
        Path | None, Option(metavar="DIR", help="The daemon's $RUNTIME_DIRECTORY; default: ours, or /run/fleetmap.")
    ] = None,
) -> None:
    """Print the last status of the running daemon; exit status 3 if it is older than ten seconds."""
    from locclient.daemon.service_manager import last_status, runtime_folder

    echo(last_status(folder or runtime_folder() or Path("/run/fleetmap")))


COMMANDS: Commands = {"enrol": enrol, "replay": replay, "run": run, "status": status}


def locclient(version: Version = False) -> None:
    """Localize a camera robot in the maps of its fleet."""


def _read_config(path: Path | None) -> "tuple[LocclientConfig, Options]":
    from locclient.config import read_config

    return read_config(path, {"replay": replay})  # [run] holds settings, not options


app = make_app(COMMANDS, locclient, _read_config, "locclient.commands")

# Set before numpy is imported: matrix products are small, and a second BLAS thread costs more than it saves.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    """Run the command line."""
    run_cli(app)


if __name__ == "__main__":
    main()
