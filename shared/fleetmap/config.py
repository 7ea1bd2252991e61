"""Settings: frozen structs decoded from TOML, unknown keys refused, internal constants too.

Settings come in three tiers. A file may set user and tuning settings; each program lists their keys in its `Tiers`. Every other
field of a section is an internal constant: it has its reason beside it in the code, and no key in a file.
"""

import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec

from fleetmap.errors import UsageError

T = TypeVar("T")
Positive = Annotated[float, msgspec.Meta(gt=0)]
_MAX_FILE_BYTES = 1 << 20
# By tier and section ("" is the top of the file), keys separated by spaces, or `*`.
Tiers = Mapping[str, Mapping[str, str]]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every configuration section. Key names carry their units."""


class Setting(NamedTuple):
    """One value of a configuration."""

    section: str  # dotted name
    key: str
    value: Any


def read_given(path: Path, file_type: type[Section]) -> dict[str, Any]:
    """Return the keys that the file at `path` sets, checked against `file_type`; UsageError as `load_toml`, and for impossible numbers."""
    load_toml(path, file_type)
    given = load_toml(path, dict[str, Any])
    _check_numbers(path, given)
    return given


def _check_numbers(path: Path, given: Mapping[str, Any], section: str = "") -> None:
    """Raise UsageError for a negative or endless number: no setting has one, and NaN passes every comparison with a limit."""
    for key, value in given.items():
        if isinstance(value, dict):
            _check_numbers(path, value, f"{section}{key}.")
        elif isinstance(value, int | float) and not 0 <= value < math.inf:
            raise UsageError(f"configuration file {path}: {section}{key} = {value}: give a finite number, 0 or more")


def load_toml(path: Path, kind: type[T]) -> T:
    """Load the settings in the file at `path` as a section, whose missing keys keep their defaults, or as a dict.

    Raises UsageError naming the file and the offending key for unreadable files, unknown keys and wrong types.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_FILE_BYTES + 1)
        if len(data) > _MAX_FILE_BYTES:
            raise UsageError(f"configuration file {path} has more than {_MAX_FILE_BYTES} bytes; is it another file?")
        return msgspec.toml.decode(data, type=kind)
    except OSError as error:
        raise UsageError(f"configuration file {path} cannot be read ({error.strerror}); check the path") from error
    # tomllib's own errors for invalid UTF-8, impossible dates and deep nesting
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        fault = f"{str(error)[:500]}{_given_there(data, str(error))}"
        raise UsageError(f"configuration file {path}: {fault}; docs/settings.md lists the settings") from error


def _given_there(data: bytes, fault: str) -> str:
    """Return words with the value that the file gives where msgspec finds a fault; none for a whole section."""
    place = re.search(r" at `\$\.([\w.]+)`$", fault)
    if place is None:
        return ""
    value: Any = reduce(getitem, place[1].split("."), tomllib.loads(data.decode()))
    return "" if isinstance(value, dict) else f", which is {value!r:.100}"


def settings_in(section: Section, name: str = "") -> Iterator[Setting]:
    """All values of a section and of the sections in it, in order."""
    for field in msgspec.structs.fields(section):
        value = getattr(section, field.name)
        if isinstance(value, Section):
            yield from settings_in(value, f"{name}.{field.encode_name}".lstrip("."))
        else:
            yield Setting(name, field.encode_name, value)


def tier_of(setting: Setting, tiers: Tiers) -> str | None:
    """Tier of a setting, None for an internal constant."""
    fitting = (name for name, keys in tiers.items() if {setting.key, "*"} & set(keys.get(setting.section, "").split()))
    return next(fitting, None)


def refuse_internal(path: Path, given: Mapping[str, Any], defaults: Section, tiers: Tiers) -> None:
    """Raise UsageError if the file at `path`, with the keys `given`, sets an internal constant of `defaults`."""
    for setting in settings_in(defaults):
        section: Any = given
        for word in filter(None, setting.section.split(".")):
            section = section.get(word, {})
        if setting.key in section and tier_of(setting, tiers) is None:
            name = f"{setting.section}.{setting.key}".lstrip(".")
            raise UsageError(
                f"configuration file {path}: {name} is an internal constant now; delete the key. "
                "docs/settings.md lists the settings"
            )


def over(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the contents of two files; `above` takes precedence."""
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        merged[key] = over(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged
