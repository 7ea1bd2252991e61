"""The command `mapserver`. Heavy imports happen inside the commands, after their arguments are checked."""

import os

import typer

from fleetmap.cli_exit import run
from mapserver.commands.build import build
from mapserver.commands.config_option import ConfigFile
from mapserver.commands.convert import convert
from mapserver.commands.doctor import doctor
from mapserver.commands.evaluate import evaluate
from mapserver.commands.fleet import fleet_app
from mapserver.commands.nightly import nightly
from mapserver.commands.releases.diff import diff
from mapserver.commands.releases.inspect import inspect
from mapserver.commands.releases.promote import promote
from mapserver.commands.releases.publish import publish
from mapserver.commands.releases.rollback import rollback
from mapserver.commands.releases.versions import versions
from mapserver.commands.serve import serve
from mapserver.commands.store.export import export
from mapserver.commands.store.gc import gc
from mapserver.commands.store.import_ import import_
from mapserver.commands.store.verify import verify
from mapserver.commands.train_vocabulary import train_vocabulary

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
