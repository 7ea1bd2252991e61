"""Settings of the connection to a fleet manager, and of the reported state."""

import re
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from fleetmap.bus.endpoints import is_loopback_name
from fleetmap.config import Section
from fleetmap.errors import UsageError, disk_errors

_LEVEL = re.compile(r"[^/+#\0]{1,128}")
_BROKER = re.compile(r"(mqtts?)://([^/:@\s]+|\[[0-9a-fA-F:]+\])(?::(\d{1,5}))?/?")
_MAX_SECRET_BYTES = 4096
_Positive = Annotated[float, msgspec.Meta(gt=0, le=3600)]


class Vda5050Section(Section, frozen=True):
    """Broker, name of the robot there, and selection of its map. Without a broker nothing is reported."""

    broker: str | None = None
    version: Literal["2.0.0", "2.1.0", "3.0.0"] = "3.0.0"
    manufacturer: str = ""
    serial_number: str = ""
    interface: str = "vda5050"
    username: str | None = None
    password_file: str | None = None
    ca: str | None = None
    map_id: str | None = None
    versions: Literal["fleet manager", "map server"] = "fleet manager"
    frame: Literal["map", "building"] = "map"
    download_from: tuple[str, ...] = ()
    download_token_file: str | None = None
    download_ca: str | None = None
    robot_actions: tuple[str, ...] = ()
    factsheet: str | None = None
    state_interval_s: Annotated[float, msgspec.Meta(gt=0, le=30)] = 1.0  # VDA 5050 wants 30 at most
    robot_silent_s: _Positive = 10.0
    initialize_s: _Positive = 15.0
    # Priors up to 0.1 count as a dock's, against which estimates are checked
    initial_sigma_m: Annotated[float, msgspec.Meta(ge=0.15, le=3600)] = 0.5
    initial_sigma_rad: _Positive = 0.2


def check_section(section: Vda5050Section, *, insecure: bool) -> tuple[str, int, bool, str | None]:
    """Return the broker's host and port, True for TLS, and the password; UsageError for missing or invalid settings."""
    match = _BROKER.fullmatch(section.broker or "")
    if match is None:
        raise UsageError(f"[vda5050] broker = {section.broker!r} is not like mqtts://HOST or mqtts://HOST:PORT")
    for name in ("interface", "manufacturer", "serial_number"):
        value = getattr(section, name)
        if not _LEVEL.fullmatch(value):
            raise UsageError(f"[vda5050] {name} = {value!r}: a level of an MQTT topic, without / + and #, is needed")
    if section.version == "2.0.0" and section.versions == "fleet manager":
        raise UsageError(
            '[vda5050] version = "2.0.0" has no actions on maps: set versions = "map server", or version = "2.1.0"'
        )
    scheme, host, port = match[1], match[2].strip("[]"), int(match[3] or (8883 if match[1] == "mqtts" else 1883))
    if scheme == "mqtt" and not insecure and not is_loopback_name(host):
        raise UsageError(
            f"[vda5050] broker = {section.broker!r} is on another machine and without TLS; use mqtts://, or --insecure"
        )
    if (section.username is None) != (section.password_file is None):
        raise UsageError("[vda5050] username and password_file belong together")
    password = None if section.password_file is None else read_secret(section.password_file)
    return host, port, scheme == "mqtts", password


def read_secret(path: str) -> str:
    """Return the first line of a file; UsageError if it cannot be a secret."""
    with disk_errors(f"[vda5050] {path} cannot be read", "check the path and its rights", UsageError):
        data = Path(path).read_bytes()[: _MAX_SECRET_BYTES + 1]
    lines = data.decode("utf-8", "replace").splitlines()
    if not lines or len(data) > _MAX_SECRET_BYTES or not lines[0].isprintable():
        raise UsageError(f"[vda5050] {path} holds no line of at most {_MAX_SECRET_BYTES} bytes")
    return lines[0]
