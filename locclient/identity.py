"""A robot's identity: the folder that enrolment fills, and the settings that it gives every connection to the server.

robot.pem      key and certificate in one file, so that both change atomically; the robot is enrolled if it exists
next.pem       the key that waits for its certificate; written before the request, because responses may be lost
servers.ca     authorities of servers' certificates        root.json    keys of trusted lists of maps
identity.json  site, robot and endpoint
"""

import os
from contextlib import suppress
from dataclasses import dataclass, fields
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Self

import msgspec

from fleetmap.bus.endpoints import TlsFiles, check_endpoint, handshake_fault, has_tls, is_loopback
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import LinkError, StateError, UsageError, disk_errors
from fleetmap.files import write_atomically
from fleetmap.mapformat.names import check_name
from fleetmap.messages import decode_message, robot_key

if TYPE_CHECKING:
    from fleetmap.trust.enrolment import CertificateInfo

_LIFE, _RENEW_AFTER = timedelta(days=365), timedelta(days=30)  # a robot parked for eleven months can reconnect
_ANSWER_S = 20.0
_LISTENS_S = 5.0  # a server that takes up new robots listens again within that
_FILES = ("robot.pem", "identity.json", "servers.ca", "root.json")
_ENROL = "enrol it: `mapserver robots enrol ROBOT --site SITE` on the server, `locclient enrol ROBOT.fleetmap` here"


class Identity(msgspec.Struct, frozen=True, kw_only=True):
    """Site and name of the robot, endpoint of its server."""

    site: str
    robot: str
    endpoint: str


class RobotIdentity:
    """One folder, accessible to this account only."""

    def __init__(self, folder: Path, who: Identity) -> None:
        self.folder, self.who = folder, who

    @classmethod
    def load(cls, folder: Path, *, may_be_begun: bool = False) -> Self | None:
        """Load the identity in a folder, None if the robot is not enrolled; UsageError if it cannot be read, or is half of one.

        may_be_begun: None, too, after an enrolment that did not end."""
        with disk_errors(f"the identity in {folder} cannot be read", "check whose account this is", UsageError):
            lacking = [name for name in _FILES if not (folder / name).is_file()]
            if len(lacking) == len(_FILES) or (may_be_begun and "robot.pem" in lacking):
                return None
            if lacking:
                why = "its enrolment did not end" if "robot.pem" in lacking else "remove the folder"
                raise UsageError(f"{folder} holds half an identity, without {', '.join(lacking)}: {why}; {_ENROL}")
            data = (folder / "identity.json").read_bytes()
        words = f"the identity in {folder} is damaged ({{}}); remove the folder and {_ENROL}"
        return cls(folder, decode_json(data, Identity, words, UsageError))

    @property
    def tls(self) -> TlsFiles:
        return TlsFiles(self.folder / "servers.ca", self.folder / "robot.pem")

    def certificate(self) -> "CertificateInfo":
        """Return details of the robot's certificate; UsageError for a damaged file."""
        from fleetmap.trust.enrolment import certificate_info

        return certificate_info(self._read("robot.pem"))

    def is_renewal_due(self, now: datetime) -> bool:
        """Return True if the certificate is a month old, or was signed while the server's clock was ahead."""
        return not _LIFE - _RENEW_AFTER <= (self.certificate().ends - now) <= _LIFE + timedelta(days=1)

    def renew(self, bus: Bus) -> None:
        """Replace key and certificate by new ones; open connections are not affected.

        Raises LinkError if the server is unreachable or refuses, StoreError on a disk error. The old ones stay then.
        """
        self._ask(bus, self._read("robot.pem"))

    @classmethod
    def enrol(cls, folder: Path, bundle: bytes) -> Self:
        """Enrol with a bundle and return the identity. May be repeated if the response was lost.

        Raises UsageError for an invalid bundle, StateError if the robot has an identity, LinkError if the server is unreachable or
        refuses.
        """
        from fleetmap.trust.enrolment import decode_bundle

        given = decode_bundle(bundle)
        who = Identity(
            site=check_name(given.site, "site"),
            robot=check_name(given.robot, "robot"),
            endpoint=check_endpoint(given.endpoint),
        )
        before = cls.load(folder, may_be_begun=True)
        if before is not None:
            raise StateError(
                f"{folder} holds the identity of {before.who.robot} at {before.who.site}; remove it if the robot is to be "
                "another one"
            )
        made = cls(folder, who)
        with disk_errors(f"{folder} cannot be written", "choose another folder by --identity"):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            folder.chmod(0o700)
        made._write("servers.ca", given.servers.encode())
        made._write("root.json", given.root.encode())
        made._write("bundle.pem", given.own.encode())
        made._write("identity.json", to_json(who))
        first = TlsFiles(folder / "servers.ca", folder / "bundle.pem")
        if fault := handshake_fault(who.endpoint, first, _LISTENS_S):
            raise LinkError(f"{who.endpoint}: {fault}")
        with Bus(who.endpoint, tls=first).open() as bus:
            made._ask(bus, given.own.encode())
        (folder / "bundle.pem").unlink(missing_ok=True)
        return made

    def _ask(self, bus: Bus, old: bytes) -> None:
        from fleetmap.trust import enrolment

        key = self._next_key(old)
        renew, question = robot_key(self.who.site, self.who.robot, "renew"), enrolment.renewal_request(old, key)
        answer = decode_message(bus.get(renew, question, timeout_s=_ANSWER_S), enrolment.RenewalAnswer)
        if enrolment.certificate_info(answer.certificate.encode()).fingerprint != enrolment.key_fingerprint(key):
            raise LinkError("the server answered with a certificate of another key; who answers there?")
        # Written before the certificate: with it the robot may connect to a server signed by another authority.
        self._write("servers.ca", answer.servers.encode())
        self._write("robot.pem", key + answer.certificate.encode())
        with suppress(OSError):  # a leftover key that has a certificate is not requested again
            (self.folder / "next.pem").unlink()

    def _next_key(self, old: bytes) -> bytes:
        from fleetmap.trust import enrolment

        path = self.folder / "next.pem"
        if path.is_file():
            key = self._read("next.pem")
            if enrolment.key_fingerprint(key) != enrolment.key_fingerprint(old):
                return key
        self._write("next.pem", enrolment.new_key())
        return self._read("next.pem")

    def _read(self, name: str) -> bytes:
        with disk_errors(f"{self.folder / name} cannot be read", "check whose account this is", UsageError):
            return (self.folder / name).read_bytes()

    def _write(self, name: str, data: bytes) -> None:
        """Write atomically, for this account only, also in a power failure."""
        with disk_errors(f"{self.folder / name} cannot be written", "make space, or choose another folder"):
            write_atomically(self.folder / name, [data])


@dataclass(frozen=True, kw_only=True)
class MapAddress:
    """Source of a robot's map: `server`, an endpoint, or `store`, a folder; neither if a fleet manager brings it. identity: for servers
    that authenticate robots.

    version: number in the store, drafts included; None for the current one.
    """

    site: str
    robot: str
    server: str | None = None
    store: str | Path | None = None
    root: str | Path | None = None
    identity: RobotIdentity | None = None
    version: int | None = None

    @classmethod
    def of(
        cls, settings: object, *, sign: str = "", usual_robot: str = "", may_be_alone: bool = False, **more: Any
    ) -> Self:
        """Return the address by the settings of these names, of an object or in `more`; missing ones come from the identity.

        sign: before the names in messages. usual_robot: the name of a robot that has none. may_be_alone: with neither server nor store, if
        a link brings its maps. UsageError for contradictions, and for a server on another machine that cannot authenticate the robot.
        """
        names = [*(field.name for field in fields(cls)), "insecure"]
        given = SimpleNamespace(**{name: getattr(settings, name, None) for name in names} | more)
        if given.server is not None and given.store is not None:
            raise UsageError(f"give either {sign}server, such as tls/HOST:7447, or {sign}store, a folder")
        folder = identity_folder(given.identity)
        has_use = given.store is None and (given.server is None or has_tls(given.server))
        identity = RobotIdentity.load(folder) if has_use else None
        usual = {"site": given.site or None, "robot": given.robot or usual_robot or None}

        def named(what: str) -> str:
            name: str | None = usual[what] if identity is None else getattr(identity.who, what)
            if name is None:
                raise UsageError(f"{sign}{what} is missing: which site's map, and who asks?")
            if identity is not None and getattr(given, what) not in {None, name}:
                asked = f"{what} {getattr(given, what)} is asked for"
                raise UsageError(f"{asked}, but {identity.folder} is enrolled as {what} {name}")
            return check_name(name, what)

        if identity is None:
            named("site")  # first error of an empty configuration
        server = given.server or (None if identity is None else identity.who.endpoint)
        if server is None and given.store is None and not may_be_alone:
            raise UsageError(
                f"give either {sign}server, such as tcp/127.0.0.1:7447, or {sign}store, a folder; or {_ENROL}"
            )
        if server is None or not has_tls(server):
            identity = None
            check_reach(server, insecure=bool(given.insecure), sign=f"{sign}server = ")
        elif identity is None:
            raise UsageError(f"this robot has no identity in {folder}, which {server} asks for; {_ENROL}")
        if given.version is not None and given.store is None:
            raise UsageError(
                f"{sign}version {given.version} needs {sign}store DIR: a server gives the version that its robots should run"
            )
        root = given.root or (None if identity is None else folder / "root.json")
        where = {"server": server, "store": given.store, "root": root}
        return cls(site=named("site"), robot=named("robot"), **where, identity=identity, version=given.version)


def check_reach(endpoint: str | None, *, insecure: bool, sign: str = "") -> None:
    """Raise UsageError for a malformed endpoint, and unless `insecure` for one on another machine without TLS. sign: begins the message."""
    if endpoint is None:
        return
    try:
        check_endpoint(endpoint)
    except UsageError as error:
        raise UsageError(f"{sign}{error}") from error
    if has_tls(endpoint) or is_loopback(endpoint) or insecure:
        return
    raise UsageError(
        f"{sign}{endpoint} is on another machine and without TLS: others on the network can read and answer. Use tls/HOST:PORT, or "
        "--insecure if no other devices are on that network"
    )


def identity_folder(setting: str | Path | None = None) -> Path:
    """Return the folder of the setting, else `identity` in the unit's or user's state folder (STATE_DIRECTORY, XDG_STATE_HOME)."""
    if setting is not None:
        return Path(setting)
    if unit := os.environ.get("STATE_DIRECTORY"):
        return Path(unit.split(":")[0]) / "identity"
    return Path(os.environ.get("XDG_STATE_HOME", str(Path.home() / ".local" / "state"))) / "fleetmap" / "identity"
