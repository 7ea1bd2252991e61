"""Settings: frozen structs decoded from TOML, unknown keys refused."""

from pathlib import Path
from typing import TypeVar

import msgspec

from fleetmap.errors import UsageError

S = TypeVar("S", bound="Section")


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every configuration section. Key names carry their units."""


def load_toml(path: Path, section_type: type[S]) -> S:
    """The settings of the file at `path`; keys that it leaves out keep their defaults.

    Raises UsageError naming the file and the offending key for unreadable files, unknown keys and wrong types.
    """
    try:
        return msgspec.toml.decode(path.read_bytes(), type=section_type)
    except OSError as error:
        raise UsageError(f"configuration file {path} cannot be read ({error.strerror}); check the path") from error
    except msgspec.MsgspecError as error:
        raise UsageError(f"configuration file {path}: {error}; the settings are listed in the README") from error


def to_dict(section: Section) -> dict[str, object]:
    """The effective configuration as plain values, for reports and manifests."""
    built: dict[str, object] = msgspec.to_builtins(section)
    return built
