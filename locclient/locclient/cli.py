"""The command `locclient`. Heavy imports happen inside the commands, after their arguments are checked."""

import os
from importlib import import_module
from pkgutil import iter_modules

import typer

from fleetmap.cli_exit import run
from locclient import commands

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.callback()
def locclient() -> None:
    """Localise a camera robot in the maps of its fleet."""


# One file in `commands` for each command, with a function of the same name.
for _module in sorted(iter_modules(commands.__path__), key=lambda module: module.name):
    app.command()(getattr(import_module(f"{commands.__name__}.{_module.name}"), _module.name))


# Before anything imports numpy: many small products, for which a second BLAS thread costs more than it brings.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    """Runs the command line."""
    run(app)


if __name__ == "__main__":
    main()
