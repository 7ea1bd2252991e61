"""`locclient config show`: the effective configuration file."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import Group


def show(config: Annotated[Path | None, typer.Option(metavar="FILE", help="TOML file with settings.")] = None) -> None:
    """Print the effective configuration as TOML, with the origin of every value."""
    import msgspec

    from fleetmap.config_show import Layer, effective_settings
    from locclient.config import TIERS, read_config, with_common

    settings = read_config(config)
    given = {} if config is None else msgspec.toml.decode(config.read_bytes())
    typer.echo("\n".join(effective_settings(settings, TIERS, (Layer(str(config), with_common(given)),))))


CONFIG = Group("The configuration file.", {"show": show})
