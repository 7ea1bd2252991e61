"""State of the signed lists: keys, expiry, and keys exposed to a thief of the server."""

import msgspec

from fleetmap.errors import StateError
from fleetmap.trust.site_list import site_role
from mapserver.store import MapStore
from mapserver.trust.enrolment import RobotRegister
from mapserver.trust.keys import KeyFolder
from mapserver.trust.lists import TIMESTAMP, SignedLists

# Days before expiry at which a role is to be signed again: by an operator with the root key; by the server.
_ENDS_SOON = {"root": 60, "targets": 30, "snapshot": 1, TIMESTAMP: 0.25}
_SITE_ENDS_SOON = 7
_CERTIFICATE_ENDS_SOON = 30


class RoleStatus(msgspec.Struct, frozen=True):
    """One role. number: of its newest file, 0 if absent."""

    role: str
    number: int
    expires: str | None
    days_left: float | None
    fault: str = ""


class CertificateStatus(msgspec.Struct, frozen=True):
    """One certificate of the bus, by its file."""

    file: str
    days_left: float
    fault: str = ""


class TrustStatus(msgspec.Struct):
    """All roles and certificates. faults: reasons why robots cannot get new maps, now or soon; risks: actions possible for a
    thief of this machine.
    """

    roles: list[RoleStatus] = []
    certificates: list[CertificateStatus] = []
    faults: list[str] = []
    risks: list[str] = []


def trust_status(store: MapStore) -> TrustStatus:
    """Return the state of the store's lists; StateError if absent, StoreError if unreadable."""
    lists, found = SignedLists(store.folder), TrustStatus()
    if not lists.are_there:
        raise StateError(
            f"{store.folder} has no signed lists; `mapserver trust init --store {store.folder}` makes them"
        )
    now, known = store.now(), lists.site_roles()
    for name in ("root", "targets", "snapshot", TIMESTAMP, *known):
        number, fault = lists.newest(name), ""
        if name == TIMESTAMP and lists.path(name, 0).is_file():
            number = lists.read(name).version
        if not number:
            found.roles.append(RoleStatus(name, 0, None, None, "nothing was signed yet"))
            continue
        expires = lists.read(name).expires
        days_left = (expires - now).total_seconds() / 86_400
        if days_left < _ENDS_SOON.get(name, _SITE_ENDS_SOON):
            soon = f"ends in {days_left:.1f} days: sign it again"
            fault = "expired: robots refuse new maps" if days_left <= 0 else soon
        found.roles.append(RoleStatus(name, number, expires.isoformat(), round(days_left, 2), fault))
    found.faults = [f"{status.role}: {status.fault}" for status in found.roles if status.fault]
    own = KeyFolder(store.folder / "keys")
    for info in store.sites():
        role = site_role(info.site)
        if role not in known:
            if info.current_version is not None:
                found.faults.append(f"site {info.site}: no key may sign its maps; `mapserver trust admit {info.site}`")
            continue
        if lists.newest(role) and not lists.is_signed(known[role]):
            found.faults.append(
                f"list of {role}: it is not signed by its present key; look for {own.path(role)}, or name another: "
                f"`mapserver trust admit {info.site}`"
            )
        if own.has(role):
            found.risks.append(f"{own.path(role)}: a thief of this machine can publish maps of {info.site}")
    if own.has("root"):
        found.risks.append(f"{own.path('root')}: a thief of this machine can do everything, irrevocably")
    authorities = RobotRegister(store).authorities
    if not authorities.are_there:
        return found
    for file, left in authorities.days_left().items():
        fault = ""
        if left < _CERTIFICATE_ENDS_SOON:
            step = "`mapserver trust rotate server`" if file == "server.pem" else "make it again"
            fault = f"expires in {left:.1f} days, then robots cannot connect; {step}"
            found.faults.append(f"{file}: {fault}")
        found.certificates.append(CertificateStatus(file, round(left, 2), fault))
    if (authorities.folder / "servers-ca.pem").is_file():
        found.risks.append(f"{authorities.folder}/servers-ca.pem: a thief of this machine can act as the server")
    return found
