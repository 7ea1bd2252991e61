"""`mapserver config show`: the effective configuration file."""

from typing import Annotated

import typer

from fleetmap.cli_options import ConfigFile, Group, config_path, settings_of


def show(
    context: typer.Context,
    use: Annotated[str | None, typer.Option(metavar="SENSORS", help="Apply the preset of these sensors.")] = None,
    config: ConfigFile = None,
) -> None:
    """Print the effective configuration as TOML, with the origin of every value."""
    settings = settings_of(context)
    import msgspec

    from fleetmap.config_show import Layer, command_options, effective_settings
    from mapserver.config import TIERS, preset, survey_settings
    from mapserver.drafting.sensor_subset import named_sensor_set

    path = config_path(context)
    given = {} if path is None else msgspec.toml.decode(path.read_bytes())
    layers: tuple[Layer, ...] = (Layer(str(path), given),)
    if use is not None:
        sensors = named_sensor_set(use)
        settings = msgspec.structs.replace(settings, survey=survey_settings(path, sensors))
        layers = (*layers, Layer(f"preset {sensors.value}", {"survey": preset(sensors)}))
    lines = [*effective_settings(settings, TIERS, layers)]
    _, defaults = context.obj.read_config(path)
    for name, command in context.obj.commands.items():
        section = name.replace("-", "_")
        if not isinstance(command, Group):
            lines += command_options(section, command, defaults.get(name, {}), str(path))
            continue
        for inner, member in command.commands.items():
            lines += command_options(f"{section}.{inner}", member, defaults.get(name, {}).get(inner, {}), str(path))
    typer.echo("\n".join(lines))


CONFIG = Group("The configuration file.", {"show": show})
