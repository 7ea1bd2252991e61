"""The effective configuration as a TOML file, with the origin of every value in a comment."""

import json
from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Any, NamedTuple

from fleetmap.cli_options import Command, options_of
from fleetmap.config import Section, Setting, Tiers, settings_in, tier_of


class Layer(NamedTuple):
    """Keys that one origin sets, such as a file or a preset."""

    origin: str
    given: Mapping[str, Any]


def effective_settings(config: Section, tiers: Tiers, layers: tuple[Layer, ...]) -> Iterator[str]:
    """Lines for the user and tuning settings of `config`; the first layer that has a key is its origin."""
    settings = [setting for setting in settings_in(config) if tier_of(setting, tiers) is not None]
    for name, inside in groupby(settings, lambda setting: setting.section):
        if name:
            yield f"\n[{name}]"
        yield from (setting_line(setting, _origin(setting, layers)) for setting in inside)


def setting_line(setting: Setting, origin: str) -> str:
    """One line; a value that is not set has no TOML and becomes a comment."""
    if setting.value is None:
        return f"# {setting.key} is not set"
    return f"{setting.key} = {toml_value(setting.value)}  # {origin}"


def command_options(section: str, command: Command, given: Mapping[str, Any], origin: str) -> Iterator[str]:
    """Lines for the options of a command, of which `given` are set by the origin."""
    yield f"\n[{section}]"
    for key, parameter in options_of(command).items():
        default = None if parameter.default is parameter.empty else parameter.default
        value = given.get(parameter.name, default)
        yield setting_line(Setting(section, key, value), origin if parameter.name in given else "default")


def _origin(setting: Setting, layers: tuple[Layer, ...]) -> str:
    for origin, given in layers:
        section: Any = given
        for word in filter(None, setting.section.split(".")):
            section = section.get(word, {})
        if setting.key in section:
            return origin
    return "default"


def toml_value(value: Any) -> str:
    """A value as TOML writes it: JSON but for infinite numbers."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False, default=str)
