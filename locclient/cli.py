"""The command `locclient`. Heavy imports happen inside the commands, after their arguments are checked."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from fleetmap.cli_exit import run_cli
from fleetmap.cli_options import Commands, Options, Version, make_app
from locclient.commands.check import check
from locclient.commands.config import CONFIG
from locclient.commands.enrol import enrol
from locclient.commands.prepare import prepare
from locclient.commands.replay import replay
from locclient.commands.run import run
from locclient.commands.status import status

if TYPE_CHECKING:
    from locclient.config import LocclientConfig

COMMANDS: Commands = {
    "enrol": enrol,
    "check": check,
    "replay": replay,
    "run": run,
    "status": status,
    "prepare": prepare,
    "config": CONFIG,
}


def locclient(version: Version = False) -> None:
    """Localize a camera robot in the maps of its fleet."""


def _read_config(path: Path | None) -> "tuple[LocclientConfig, Options]":
    from locclient.config import read_config

    return read_config(path, {"replay": replay})  # [run] holds settings, not options


app = make_app(COMMANDS, locclient, _read_config)

# Before anything imports numpy: many small products, for which a second BLAS thread costs more than it brings.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    """Runs the command line."""
    run_cli(app)


if __name__ == "__main__":
    main()
