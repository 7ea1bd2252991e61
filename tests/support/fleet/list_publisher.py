"""A publisher of signed lists that can be made to lie, and a robot that reads them over a bus."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import (
    DelegatedRole,
    Delegations,
    Metadata,
    MetaFile,
    Root,
    Signed,
    Snapshot,
    TargetFile,
    Targets,
    Timestamp,
)

from fleetmap.bus import Bus
from fleetmap.errors import FleetmapError
from fleetmap.mapformat import sha256_hex
from fleetmap.messages import WantedVersion, part_of, trust_key
from fleetmap.trust import TrustedMap, ask_over, manifest_target, site_role
from support.fleet.memory_bus import MemoryBus, MemoryHub

SITE = "hall"
ROLE = site_role(SITE)
TOP = ("root", "targets", "snapshot", "timestamp")


def days(number: float) -> datetime:
    return (datetime.now(UTC) + timedelta(days=number)).replace(microsecond=0)


def address(version: int) -> str:
    return sha256_hex(b"manifest %d" % version)


def wanted(version: int) -> WantedVersion:
    return WantedVersion(site=SITE, version=version, manifest_sha256=address(version))


class ListPublisher:
    """Roots, targets, the list of one site, snapshot and timestamp, each signed by one key unless a test says otherwise."""

    def __init__(self) -> None:
        self.keys = {role: [CryptoSigner.generate_ed25519()] for role in (*TOP, ROLE)}
        self.root = Root(expires=days(700), consistent_snapshot=True)
        for role in TOP:
            self.root.add_key(self.keys[role][0].public_key, role)
        names = DelegatedRole(ROLE, [], 1, terminating=True, paths=[manifest_target(SITE, "*")])
        self.targets = Targets(expires=days(300), delegations=Delegations(keys={}, roles={ROLE: names}))
        self.targets.add_key(self.keys[ROLE][0].public_key, ROLE)
        self.site = Targets(expires=days(14))
        self.snapshot = Snapshot(expires=days(7), meta={"targets.json": MetaFile(1), f"{ROLE}.json": MetaFile(1)})
        self.timestamp = Timestamp(expires=days(1))
        self.files: dict[str, bytes] = {}
        self.asked: list[str] = []
        self.admit(1)
        for role in (*TOP, ROLE):
            self.write(role)

    def signed(self, role: str) -> Signed:
        return self.site if role == ROLE else getattr(self, role)

    def admit(self, *versions: int) -> None:
        """The last one is current, the others were before."""
        self.site.targets.clear()
        for version in versions:
            target = TargetFile.from_data(manifest_target(SITE, version), b"manifest %d" % version, ["sha256"])
            state = "current" if version == versions[-1] else "previous"
            about = {"version": version, "state": state, "vocabulary": "0" * 64}
            target.unrecognized_fields["custom"] = about
            self.site.targets[target.path] = target

    def write(self, role: str, change: Callable[[bytes], bytes] = lambda data: data) -> None:
        """Signs a role as it is and puts it among the files."""
        signed = self.signed(role)
        metadata = Metadata(signed)
        for key in self.keys[role]:
            metadata.sign(key, append=True)
        name = "timestamp.json" if role == "timestamp" else f"{signed.version}.{role}.json"
        self.files[name] = change(metadata.to_bytes())

    def publish(self, *roles: str) -> None:
        """The next version of these roles, each named by the one above, in the order of the arguments."""
        for role in roles:
            self.signed(role).version += 1
            self.name(role)
            self.write(role)

    def name(self, role: str) -> None:
        """Lets snapshot or timestamp name what a role is now, unsigned yet."""
        if role in ("targets", ROLE):
            self.snapshot.meta[f"{role}.json"] = MetaFile(self.signed(role).version)
        elif role == "snapshot":
            self.timestamp.snapshot_meta = MetaFile(self.snapshot.version)

    def rotate(self, *roles: str) -> None:
        """Other keys for top-level roles, in a root that is not yet published."""
        for role in roles:
            for keyid in list(self.root.roles[role].keyids):
                self.root.revoke_key(keyid, role)
            self.keys[role] = [CryptoSigner.generate_ed25519()]
            self.root.add_key(self.keys[role][0].public_key, role)

    def answer(self, key: str, question: bytes) -> bytes:
        name = key.rpartition("/")[2]
        self.asked.append(name)
        return part_of(self.files.get(name, b""), question)


class ListReader:
    """A robot's folder of signed lists, read with a clock that may be wrong."""

    def __init__(self, folder: Path, bus: Bus, root: bytes | None) -> None:
        self.folder, self.ahead_s = folder, 0.0
        self._root, self._bus = root, bus
        self.start()

    def start(self) -> None:
        """As after a restart of the robot."""

        def wall_s() -> float:
            return datetime.now(UTC).timestamp() + self.ahead_s

        self.trust = TrustedMap(self.folder, SITE, self._root, ask_over(self._bus, SITE, 0.3), wall_s)

    def refused(self, version: int) -> str:
        """Why a version may not be run after another question to the server; empty where it may."""
        self.trust.refresh()
        try:
            self.trust.admitted(wanted(version))
        except FleetmapError as error:
            return str(error)
        return ""

    def number(self, role: str) -> int | None:
        path = self.folder / f"{role}.json"
        return Metadata.from_file(str(path)).signed.version if path.is_file() else None


@contextmanager
def bus_pair(kind: str) -> Iterator[tuple[Bus, Bus]]:
    """A server's and a robot's bus: `memory` or `zenoh`."""
    if kind == "memory":
        hub = MemoryHub()
        with MemoryBus(hub) as server, MemoryBus(hub) as robot:
            yield server, robot
    else:
        with Bus.listen("tcp/127.0.0.1:0") as server, Bus.connect(server.endpoint) as robot:
            yield server, robot


@contextmanager
def reading(publisher: ListPublisher, buses: tuple[Bus, Bus], folder: Path) -> Iterator[ListReader]:
    """A robot with the publisher's first root."""
    handle = buses[0].queryable(trust_key("*", "*"), publisher.answer)
    try:
        yield ListReader(folder, buses[1], publisher.files["1.root.json"])
    finally:
        handle.close()
