"""The robots allowed on the bus: enrolled by a bundle, renewed automatically, revoked by a command.

STORE/keys/robots.json lists them. The rules of the bus contain these robots only.
"""

import hashlib
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime

import msgspec

from fleetmap.access import Access, Holder, Purpose
from fleetmap.bus.endpoints import TlsFiles
from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import LinkError, StateError, StoreError, disk_errors
from fleetmap.files import write_atomically
from fleetmap.mapformat.names import check_name
from fleetmap.messages import encode_message
from fleetmap.trust.enrolment import Bundle, RenewalAnswer, certificate_info, check_request, key_fingerprint
from mapserver.store import NOBODY, Actor, MapStore
from mapserver.store.files import file_mark, make_folder
from mapserver.trust.authorities import DAYS, Authorities
from mapserver.trust.lists import SignedLists

LISTENING = "tls/0.0.0.0:7447"
"""Default endpoint for enrolled robots; its host is the server's name."""

SURVEY = Holder("live.survey", purpose=Purpose.SURVEY)
_DAY_NS = 86_400_000_000_000
_RULES_NS = _DAY_NS // 2
_MAX_ROBOTS = 20_000
_NAME_LENGTH = 40  # a certificate's name has 64 characters at most; the mark after it makes it unique


@dataclass(frozen=True, slots=True)
class EnrolledRobot:
    """A robot that is admitted to the bus. certificate: the name in it; days_left: of it, or of the bundle while that is not used."""

    site: str
    robot: str
    certificate: str
    enrolled_ns: int
    is_used: bool
    days_left: float
    state: str


class Enrolment(msgspec.Struct, frozen=True, kw_only=True):
    """One robot. key: fingerprint of the key that may renew; before: of the key that it replaced, in case the answer was lost.

    mark: suffix of the name in its certificates, changed by each renewal, so that rules can distinguish them; mark_before:
    of the previous certificate. renewed_ns: time of its last certificate, None while its bundle is unused.
    """

    site: str
    robot: str
    mark: str
    key: str
    before: str = ""
    mark_before: str = ""
    enrolled_ns: int
    renewed_ns: int | None = None

    @property
    def certificate(self) -> str:
        return self._named(self.mark)

    @property
    def next_mark(self) -> str:
        """Mark of its next certificate: known in advance, so that a renewal need not change the rules."""
        return hashlib.sha256(self.mark.encode()).hexdigest()[:8]

    def holders(self, now_ns: int, floors: tuple[str, ...] = ()) -> Iterator[Holder]:
        """Yield the certificates allowed for this robot. A renewed one ends after 12 to 24 hours, for all robots at the same
        time, because new rules interrupt all connections: from then on it may only repeat the renewal, whose answer may have been lost."""
        yield Holder(self.certificate, self.site, self.robot, floors=floors)
        started_ns = (now_ns // _RULES_NS - 1) * _RULES_NS
        is_new = self.renewed_ns is None or started_ns <= self.renewed_ns <= now_ns + _RULES_NS
        if self.mark_before:
            purpose = Purpose.ROBOT if is_new else Purpose.ENROL
            yield Holder(self._named(self.mark_before), self.site, self.robot, purpose, floors)
        if not is_new or not self.mark_before:
            yield Holder(self._named(self.next_mark), self.site, self.robot, floors=floors)

    def _named(self, mark: str) -> str:
        return f"{self.robot[:_NAME_LENGTH]}.{mark}"

    @property
    def bundle(self) -> str:
        """Name in the certificate of its bundle."""
        return f"{self.certificate}.enrol"

    def shown(self, now_ns: int) -> EnrolledRobot:
        """Return it as people see it."""
        since_ns = self.enrolled_ns if self.renewed_ns is None else self.renewed_ns
        left = DAYS["enrol" if self.renewed_ns is None else "robot"] - (now_ns - since_ns) / _DAY_NS
        if self.renewed_ns is None:
            state = f"bundle unused, {24 * left:.0f} h left" if left > 0 else "bundle expired: enrol again"
        else:
            state = f"certificate for {left:.0f} days" if left > 0 else "certificate expired: revoke and enrol again"
        used = self.enrolled_ns, self.renewed_ns is not None
        return EnrolledRobot(self.site, self.robot, self.certificate, *used, round(left, 2), state)


class RobotRegister:
    """The enrolled robots of a store. Thread-safe; sees writes of other processes at once."""

    def __init__(self, store: MapStore) -> None:
        self.store = store
        self._keys = store.folder / "keys"
        self._path = self._keys / "robots.json"

    @property
    def authorities(self) -> Authorities:
        return Authorities(self._keys, self.store.now())

    @property
    def tls(self) -> TlsFiles:
        """The server's files; StateError if absent."""
        authorities = self.authorities
        if not authorities.are_there:
            folder = self.store.folder
            raise StateError(
                f"{folder} has no certificate for its server; `mapserver trust init --here --host NAME --store {folder}` "
                "makes one, with the NAME or address of this machine for robots"
            )
        return authorities.tls

    def robots(self, site: str | None = None) -> list[Enrolment]:
        """Return all robots (of a site), by site and name; StoreError if the file is unreadable."""
        if not self._path.is_file():
            return []
        with disk_errors(f"{self._path} cannot be read", "check the account"):
            data = self._path.read_bytes()
        found = decode_json(data, list[Enrolment], f"{self._path} cannot be read ({{}}); restore it", StoreError)
        return [entry for entry in found if site in {None, entry.site}]

    def access(self) -> Access:
        """Return the present rules for the bus."""
        now_ns, holders = self.store.now_ns(), [SURVEY]
        for entry in self.robots():
            holders.extend(entry.holders(now_ns, self._floors(entry.site)))
            # Used ones too, while their certificate is valid: the owner of a copy then gets a reason, and it is logged.
            if now_ns - entry.enrolled_ns < DAYS["enrol"] * _DAY_NS:
                holders.append(Holder(entry.bundle, entry.site, entry.robot, Purpose.ENROL))
        return Access(holders)

    def state(self) -> object:
        """Return a value that changes with robots, buildings, an authority or the server's certificate."""
        return (file_mark(self._path), self.tls_state(), [self._floors(info.site) for info in self.store.sites()])

    def _floors(self, site: str) -> tuple[str, ...]:
        """Return the other floors of a site's building."""
        building = self.store.building(site)
        return () if building is None else tuple(floor.site for floor in building.floors if floor.site != site)

    def tls_state(self) -> object:
        tls = self.authorities.tls
        return (file_mark(tls.authority), file_mark(tls.own))

    def enrol(self, site: str, robots: Sequence[str], endpoint: str, *, actor: Actor = NOBODY) -> dict[str, bytes]:
        """Return the bundle of each robot. An unused earlier bundle is replaced and becomes invalid.

        Raises StateError for enrolled robots and an endpoint that is not in the server's certificate, UsageError for invalid names.
        """
        check_name(site, "site")
        _ = self.tls
        authorities, lists = self.authorities, SignedLists(self.store.folder)
        if endpoint.partition("/")[2].rpartition(":")[0].strip("[]") not in authorities.hosts:
            raise StateError(
                f"robots would refuse the server at {endpoint}: its certificate names {', '.join(authorities.hosts)}; name one of "
                "them, or make another certificate: `mapserver trust rotate server --host ...`"
            )
        if not lists.are_there:
            raise StateError(f"the maps of {self.store.folder} are not signed; `mapserver trust init` comes first")
        root = lists.path("root", lists.newest("root")).read_text("utf-8")
        bundles = {}
        with self._changing() as entries:
            for robot in dict.fromkeys(robots):
                known = entries.get((site, check_name(robot, "robot")))
                if known is not None and known.renewed_ns is not None:
                    raise StateError(
                        f"robot {robot} of site {site} is enrolled; if it lost its key: `mapserver robots revoke {robot}` first"
                    )
                if known is None and len(entries) >= _MAX_ROBOTS:
                    raise StateError(f"{len(entries)} robots are enrolled, the limit of a server; revoke some")
                mark = secrets.token_hex(4)
                entry = Enrolment(site=site, robot=robot, mark=mark, key="", enrolled_ns=self.store.now_ns())
                own = authorities.make_own(entry.bundle, "enrol")
                entries[site, robot] = msgspec.structs.replace(entry, key=key_fingerprint(own))
                bundle = Bundle(
                    format=1,
                    site=site,
                    robot=robot,
                    endpoint=endpoint,
                    servers=authorities.servers,
                    root=root,
                    own=own.decode(),
                )
                bundles[robot] = to_json(bundle, indent=2) + b"\n"
        for robot in bundles:
            self.store.audit("robot enrolled", robot, actor=actor, site=site)
        return bundles

    def revoke(self, site: str, robots: Sequence[str], *, actor: Actor = NOBODY) -> list[str]:
        """Remove robots from the rules and return those removed; a running server follows within two seconds."""
        with self._changing() as entries:
            gone = [robot for robot in dict.fromkeys(robots) if entries.pop((site, robot), None) is not None]
        for robot in gone:
            self.store.audit("robot revoked", robot, actor=actor, site=site)
        return gone

    def revoke_all(self, *, actor: Actor = NOBODY) -> int:
        """Remove all robots of all sites from the rules, and return their number."""
        entries = self.robots()
        for site in sorted({entry.site for entry in entries}):
            self.revoke(site, [entry.robot for entry in entries if entry.site == site], actor=actor)
        return len(entries)

    def renew(self, site: str, robot: str, payload: bytes) -> bytes:
        """Return the encoded answer to a robot's request for a certificate of its new key; the name in the request is ignored.

        A repeated request with the same keys is answered again, because answers get lost. Raises LinkError for all others; refusals
        are logged.
        """
        try:
            asked = check_request(payload)
            with self._changing() as entries:
                entry = entries.get((site, robot))
                if entry is None:
                    raise LinkError(f"robot {robot} of site {site} is not enrolled")
                is_repeated = (asked.old_fingerprint, asked.new_fingerprint) == (entry.before, entry.key)
                if asked.old_fingerprint != entry.key and not is_repeated:
                    raise LinkError("key may not renew: the bundle was already used, or a key restored; enrol again")
                if not is_repeated:
                    marks = {"mark": entry.next_mark, "mark_before": entry.mark} if entry.renewed_ns is not None else {}
                    keys = {"key": asked.new_fingerprint, "before": asked.old_fingerprint}
                    entry = msgspec.structs.replace(entry, **keys, **marks, renewed_ns=self.store.now_ns())
                certificate = self.authorities.sign_robot(asked.new_key, entry.certificate)
                entries[site, robot] = entry
        except LinkError as error:
            self.store.audit("renewal refused", f"{robot[:64]}: {error}"[:2000], site=site[:64])
            raise
        self.store.audit("robot renewed", f"{robot}, key {asked.new_fingerprint[:12]}", site=site)
        return encode_message(RenewalAnswer(certificate=certificate.decode(), servers=self.authorities.servers))

    def survey_tls(self) -> TlsFiles:
        """Return files for a survey of this account on the bus; StateError if the store has no authorities."""
        own = self._keys / "survey.pem"
        authorities = self.authorities
        if not authorities.are_there:
            raise StateError(f"{self.store.folder} has no certificates; run the survey where the server's store is")
        if not own.is_file() or (certificate_info(own.read_bytes()).ends - datetime.now(UTC)).days < 1:
            with disk_errors(f"{own} cannot be written", "check the account"):
                write_atomically(own, [authorities.make_own(SURVEY.certificate, "survey")])
        return TlsFiles(self._keys / "servers-ca.crt", own)

    def default_endpoint(self, listening: str) -> str:
        """Return the robots' endpoint of a server that listens here: with the first name in its certificate. StateError without one."""
        _ = self.tls
        host = self.authorities.hosts[0]
        return f"{listening.partition('/')[0]}/{f'[{host}]' if ':' in host else host}:{listening.rpartition(':')[2]}"

    @contextmanager
    def _changing(self) -> Iterator[dict[tuple[str, str], Enrolment]]:
        """Yield the robots, to be changed by one process at a time; written at the end unless an error was raised."""
        with disk_errors(f"{self._path} cannot be written", "free some space, and check the account"):
            make_folder(self._keys)
            with self.store.files.changing("keys") as root:
                before = {(entry.site, entry.robot): entry for entry in self.robots()}
                entries = dict(before)
                yield entries
                if entries != before:
                    ordered = [entries[key] for key in sorted(entries)]
                    write_atomically(root / "keys" / self._path.name, [to_json(ordered)])
