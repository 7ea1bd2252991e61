"""The command `mapserver`. Heavy imports happen inside the commands, after their arguments are checked."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from fleetmap.cli_exit import require_extra, run_cli
from fleetmap.cli_options import Commands, ConfigFile, Options, Version, make_app
from fleetmap.hooks import plugins
from mapserver.commands.build import build
from mapserver.commands.building import AREAS, BUILDING, align
from mapserver.commands.fleet import FLEET
from mapserver.commands.operation_commands import with_operations
from mapserver.commands.people import INCIDENTS, OPERATORS, ROBOTS
from mapserver.commands.recordings import convert, doctor
from mapserver.commands.releases import diff, inspect, versions
from mapserver.commands.serve import serve
from mapserver.commands.store import attach, audit, export, gc, import_, retention, verify
from mapserver.commands.trust import TRUST

if TYPE_CHECKING:
    from mapserver.config import MapserverConfig

_FIRST = (build, versions, inspect, diff, serve, verify, gc, attach, retention, export, import_, convert, doctor, align)
_COMMANDS: Commands = {
    **{command.__name__.rstrip("_"): command for command in _FIRST},
    "areas": AREAS,
    "building": BUILDING,
    "fleet": FLEET,
    "incidents": INCIDENTS,
    "robots": ROBOTS,
    "operators": OPERATORS,
    "audit": audit,
    "trust": TRUST,
    **plugins("mapserver.commands"),
}
COMMANDS = with_operations(_COMMANDS)


def mapserver(config: ConfigFile = None, version: Version = False) -> None:
    """Build, keep and serve the maps of a fleet of camera robots.

    Every option can also be set in the TOML file of --config, in a section named after its command.
    """


def _read_config(path: Path | None) -> "tuple[MapserverConfig, Options]":
    from mapserver.config import read_config

    return read_config(path, COMMANDS)


app = make_app(COMMANDS, mapserver, _read_config)

# Before anything imports numpy: for many small products a second BLAS thread costs more than it saves.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    """Run the command line. With only a robot's libraries installed, answer `--version` and otherwise name the package to install."""
    run_cli(_run)


def _run() -> None:
    if sys.argv[1:] != ["--version"]:
        require_extra("server", "mapserver")
    app()


if __name__ == "__main__":
    main()
