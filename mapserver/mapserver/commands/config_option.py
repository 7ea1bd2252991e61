"""The option --config: settings of commands from a TOML file; what stands on the command line wins."""

from pathlib import Path
from typing import Annotated

import typer


def _take_defaults(context: typer.Context, path: Path | None) -> Path | None:
    """Makes the file's section the defaults of the command (or all sections those of the commands behind it)."""
    if path is None or context.resilient_parsing:
        return path
    from mapserver.config import command_defaults, read_config

    sections = command_defaults(read_config(path))
    is_group = context.parent is None
    context.default_map = sections if is_group else sections.get(context.info_name or "", {})
    context.meta[META_KEY] = path
    return path


def config_path(context: typer.Context) -> Path | None:
    """The configuration file that was named, behind the command or before it."""
    path: Path | None = context.meta.get(META_KEY)
    return path


META_KEY = "mapserver.config"
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", is_eager=True, callback=_take_defaults, help="TOML file with settings."),
]
