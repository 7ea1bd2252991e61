"""`locclient config show`: the effective configuration file."""

import typer

from fleetmap.cli_options import ConfigFile, Group, config_path


def show(context: typer.Context, config: ConfigFile = None) -> None:
    """Print the effective configuration as TOML, with the origin of every value."""
    import msgspec

    from fleetmap.config_show import Layer, command_options, effective_settings
    from locclient.config import TIERS, with_common

    path = config_path(context)
    settings, defaults = context.obj.read_config(path)
    given = {} if path is None else with_common(msgspec.toml.decode(path.read_bytes()))
    lines = [*effective_settings(settings, TIERS, (Layer(str(path), given),))]
    lines += command_options("replay", context.obj.commands["replay"], defaults.get("replay", {}), str(path))
    typer.echo("\n".join(lines))


CONFIG = Group("The configuration file.", {"show": show})
