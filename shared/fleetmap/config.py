"""Settings: frozen structs decoded from TOML, unknown keys refused, internal constants too.

Settings come in three tiers. A file may set user and tuning settings; each program lists their keys in its `Tiers`. Every other
field of a section is an internal constant: it has its reason beside it in the code, and no key in a file.
"""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from fleetmap.errors import UsageError

S = TypeVar("S", bound="Section")
_MAX_FILE_BYTES = 1 << 20
_IN_A_VERSION = "`locclient replay RECORDING --realtime --store DIR --version N` localizes a drive in a version"
_OF_POSES = (
    "`--trajectory FILE` knows TUM, KITTI and DROID's poses.npy by their content; evo_traj writes TUM of other formats, and "
    "`--trajectory-frame camera|body` says whose poses they are"
)
_ONE_KEY = "one root key and one key a site sign now, each of them a file (docs/security.md); delete the key"
_OF_PEOPLE = (
    "a proxy that signs people in, such as oauth2-proxy, stands in front: `--sign-in-proxy ADDRESS --sign-in-group GROUP=ROLE`; "
    "docs/security.md shows it"
)
RETIRED = {  # keys of files (behind their section where that decides), and options of commands (with _ for -, or with --)
    "allow_unjudged_calibration": "`mapserver publish --trust-calibration --reason TEXT` replaces it; delete the key",
    "manifest": "`--version N` names another version of `--store DIR`",
    "walls": "`mapserver align --pin ...` replaces it; delete the key",
    "frozen": _IN_A_VERSION,
    "map": _IN_A_VERSION,
    "output.map": '`map_topic = ""` leaves /map to nav2\'s map_server, which shows files; delete the key',
    "alias_step_m": "a build measures it, and maps carry it; delete the key",
    "driver_odom_topic": "the driver's odom -> base is taken from /tf, as everybody else takes it; delete the key",
    "output.is_map_server": "nav2's map_server loads files; delete the key",
    **{f"trajectory_{item}": _OF_POSES for item in ("format", "direction", "quaternion", "stamps")},
    "foxglove": "`locclient replay --mcap FILE` writes a run, which Foxglove opens, and the dashboard shows a site; delete the key",
    "foxglove_site": "the dashboard shows every site, its robots and surveys, live; delete the key",
    "mqtt": "MQTT 5 is spoken, as by every maintained broker; delete the key",
    "ros2": "`mapserver live --foxglove PORT` shows the survey, or the server's dashboard does",
    "spool": "it is called `outbox` now",
    "spool_bytes": "it is called `outbox_bytes` now",
    "sight": "it is called `image_quality` now",
    "min_hit_share": "it is called `min_recall` now",
    **dict.fromkeys(("threshold", "public", "previous", "remove"), _ONE_KEY),
    "add": "`mapserver trust rotate root --stick DIR` makes another root key",
    **dict.fromkeys(("signer", "keys", "adopt"), "the account that serves also builds and signs; delete the key"),
    **dict.fromkeys(("with_trust", "root"), "an imported version is a draft that you judge; delete the key"),
    "--format": "the simulator writes MCAP, which every reader takes",
    "images": "the simulator stores pictures as PNG, without loss",
    "witness": "`mapserver audit --verify` checks the log by itself; delete the key",
    **{
        f"oidc_{item}": _OF_PEOPLE
        for item in ["issuer", "client", "secret", "group", "groups_claim", "name_claim", "scope"]
    },
    **dict.fromkeys(("vocabulary", "train_vocabulary"), "maps use the vocabulary that ships with fleetmap; delete it"),
}
# By tier and section ("" is the top of the file), keys separated by spaces, or `*`.
Tiers = Mapping[str, Mapping[str, str]]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every configuration section. Key names carry their units."""


class Setting(NamedTuple):
    """One value of a configuration."""

    section: str  # dotted name
    key: str
    value: Any


def load_toml(path: Path, section_type: type[S]) -> S:
    """Load the settings in the file at `path`; missing keys keep their defaults.

    Raises UsageError naming the file and the offending key for unreadable files, unknown keys and wrong types.
    """
    settings: S = _decoded(path, section_type)
    return settings


def read_given(path: Path, file_type: type[Section]) -> dict[str, Any]:
    """Return the keys that the file at `path` sets, checked against `file_type`; UsageError as `load_toml`, and for impossible numbers."""
    _decoded(path, file_type)
    given: dict[str, Any] = _decoded(path, dict[str, Any])
    _check_numbers(path, given)
    return given


def _check_numbers(path: Path, given: Mapping[str, Any], section: str = "") -> None:
    """Raise UsageError for a negative or endless number: no setting has one, and NaN passes every comparison with a limit."""
    for key, value in given.items():
        if isinstance(value, dict):
            _check_numbers(path, value, f"{section}{key}.")
        elif isinstance(value, int | float) and not 0 <= value < math.inf:
            raise UsageError(f"configuration file {path}: {section}{key} = {value}: give a finite number, 0 or more")


def _decoded(path: Path, kind: Any) -> Any:
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
        text = str(error)[:500]
        unknown = re.search(r"unknown field `(\w+)`(?: - at `\$\.([\w.]+)`)?", text)
        new = (RETIRED.get(f"{unknown[2]}.{unknown[1]}") or RETIRED.get(unknown[1])) if unknown else None
        replaced = f"; {new}" if new else ""
        raise UsageError(f"configuration file {path}: {text}{replaced}; docs/settings.md lists the settings") from error


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
