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
    for name in _words(context):
        sections = sections.get(name, {})
    context.default_map = sections
    context.meta[META_KEY] = path
    return path


def _words(context: typer.Context) -> list[str]:
    """The command's words behind the program's name: none for the program itself, two for a command of a group."""
    words: list[str] = []
    here = context
    while here.parent is not None:
        words.insert(0, here.info_name or "")
        here = here.parent  # type: ignore[assignment]
    return words


def config_path(context: typer.Context) -> Path | None:
    """The configuration file that was named, behind the command or before it."""
    path: Path | None = context.meta.get(META_KEY)
    return path


META_KEY = "mapserver.config"
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", is_eager=True, callback=_take_defaults, help="TOML file with settings."),
]
