"""The command `mapserver`. Heavy imports happen inside the commands, after their arguments are checked."""

import os

import typer

from fleetmap.command_line import run
from mapserver.commands.build import build
from mapserver.commands.config_option import ConfigFile
from mapserver.commands.convert import convert
from mapserver.commands.diff import diff
from mapserver.commands.doctor import doctor
from mapserver.commands.evaluate import evaluate
from mapserver.commands.export import export
from mapserver.commands.fleet import fleet_app
from mapserver.commands.gc import gc
from mapserver.commands.import_ import import_
from mapserver.commands.inspect import inspect
from mapserver.commands.nightly import nightly
from mapserver.commands.promote import promote
from mapserver.commands.publish import publish
from mapserver.commands.rollback import rollback
from mapserver.commands.serve import serve
from mapserver.commands.train_vocabulary import train_vocabulary
from mapserver.commands.verify import verify
from mapserver.commands.versions import versions

COMMANDS = (
    build, nightly, publish, promote, rollback, versions, inspect, diff, serve, verify, gc, export, import_,
    convert, doctor, evaluate, train_vocabulary,
)  # fmt: skip

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.callback()
def mapserver(config: ConfigFile = None) -> None:
    """Build, keep and serve the maps of a fleet of camera robots.

    Every option can also stand in the TOML file of --config, in a section named after its command.
    """


for _command in COMMANDS:
    app.command(_command.__name__.rstrip("_").replace("_", "-"))(_command)
app.add_typer(fleet_app, name="fleet")


# Before anything imports numpy: many small products, for which a second BLAS thread costs more than it brings.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    """Runs the command line."""
    run(app)


if __name__ == "__main__":
    main()
