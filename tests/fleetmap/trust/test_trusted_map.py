"""Signed lists: what a publisher may lie about or get wrong, and what a robot runs all the same. After the cases of tuf-conformance."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from unittest.mock import Mock

import pytest
from securesystemslib.signer import CryptoSigner
from tuf.api import metadata as tuf

from fleetmap.errors import FleetmapError, LinkError, UnreachableError, UntrustedError
from fleetmap.mapformat.names import sha256_hex
from fleetmap.messages import Part, WantedVersion, encode_message, robot_key
from fleetmap.trust import tuf_client
from fleetmap.trust.site_list import manifest_target, site_role
from fleetmap.trust.trusted_map import Ask, TrustedMap, ask_over
from support.fleet.memory_bus import MemoryBus, MemoryHub

SITE = "hall"
ROLE = site_role(SITE)
TOP = ("root", "targets", "snapshot", "timestamp")
ABOVE = {"snapshot": ("timestamp",), "targets": ("snapshot", "timestamp"), ROLE: ("snapshot", "timestamp")}
DAY_S = 86400.0


def days(number: float) -> datetime:
    return (datetime.now(UTC) + timedelta(days=number)).replace(microsecond=0)


def wanted(version: int) -> WantedVersion:
    return WantedVersion(site=SITE, version=version, manifest_sha256=sha256_hex(b"manifest %d" % version))


class ListPublisher:
    """Roots, targets, the list of one site, snapshot and timestamp, each signed by one key unless a test says otherwise."""

    def __init__(self) -> None:
        self.keys = {role: [CryptoSigner.generate_ed25519()] for role in (*TOP, ROLE)}
        self.root = tuf.Root(expires=days(700), consistent_snapshot=True)
        for role in TOP:
            self.root.add_key(self.keys[role][0].public_key, role)
        names = tuf.DelegatedRole(ROLE, [], 1, terminating=True, paths=[manifest_target(SITE, "*")])
        self.targets = tuf.Targets(expires=days(300), delegations=tuf.Delegations(keys={}, roles={ROLE: names}))
        self.targets.add_key(self.keys[ROLE][0].public_key, ROLE)
        self.site = tuf.Targets(expires=days(14))
        named = {f"{role}.json": tuf.MetaFile(1) for role in ("targets", ROLE)}
        self.snapshot = tuf.Snapshot(expires=days(7), meta=named)
        self.timestamp = tuf.Timestamp(expires=days(1))
        self.files: dict[str, bytes] = {}
        self.asked: list[str] = []
        self.admit(1)
        for role in (*TOP, ROLE):
            self.write(role)

    def ask(self, name: str) -> bytes | None:
        self.asked.append(name)
        return self.files.get(name)

    def signed(self, role: str) -> tuf.Signed:
        return self.site if role == ROLE else getattr(self, role)

    def file(self, role: str) -> str:
        """Name of the newest file of a role."""
        return "timestamp.json" if role == "timestamp" else f"{self.signed(role).version}.{role}.json"

    def admit(self, *versions: int) -> None:
        """The last one is current, the others were before."""
        self.site.targets.clear()
        for version in versions:
            target = tuf.TargetFile.from_data(manifest_target(SITE, version), b"manifest %d" % version, ["sha256"])
            state = "current" if version == versions[-1] else "previous"
            target.unrecognized_fields["custom"] = {"version": version, "state": state, "vocabulary": "0" * 64}
            self.site.targets[target.path] = target

    def write(self, role: str, change: Callable[[bytes], bytes] = lambda data: data) -> None:
        """Signs a role as it is and puts it among the files."""
        metadata = tuf.Metadata(self.signed(role))
        for key in self.keys[role]:
            metadata.sign(key, append=True)
        self.files[self.file(role)] = change(metadata.to_bytes())

    def name(self, role: str) -> None:
        """Lets snapshot or timestamp name what a role is now, unsigned yet."""
        if role in ("targets", ROLE):
            self.snapshot.meta[f"{role}.json"] = tuf.MetaFile(self.signed(role).version)
        elif role == "snapshot":
            self.timestamp.snapshot_meta = tuf.MetaFile(self.snapshot.version)

    def publish(self, *roles: str) -> None:
        """The next version of these roles, each named by the one above, in the order of the arguments."""
        for role in roles:
            self.signed(role).version += 1
            self.name(role)
            self.write(role)

    def renew(self, role: str) -> None:
        """The next version of a role, and of all that name it."""
        self.publish(role, *ABOVE.get(role, ()))

    def rotate(self, *roles: str) -> None:
        """Other keys for top-level roles, in a root that is not yet published."""
        for role in roles:
            for keyid in list(self.root.roles[role].keyids):
                self.root.revoke_key(keyid, role)
            self.keys[role] = [CryptoSigner.generate_ed25519()]
            self.root.add_key(self.keys[role][0].public_key, role)


class ListReader:
    """A robot's folder of signed lists, read with a clock that may be wrong."""

    def __init__(self, folder: Path, ask: Ask, root: bytes | None) -> None:
        self.folder, self.ahead_s, self._ask, self._root = folder, 0.0, ask, root
        self.start()

    def start(self) -> None:
        """As after a restart of the robot."""
        clock_s = lambda: datetime.now(UTC).timestamp() + self.ahead_s  # noqa: E731
        self.trust = TrustedMap(self.folder, SITE, self._root, self._ask, clock_s)

    def refused(self, version: int = 1) -> str:
        """Why a version may not be run after another question to the server; empty where it may."""
        self.trust.refresh()
        try:
            self.trust.admitted(wanted(version))
        except FleetmapError as error:
            return str(error)
        return ""

    def number(self, role: str) -> int | None:
        path = self.folder / f"{role}.json"
        return tuf.Metadata.from_file(str(path)).signed.version if path.is_file() else None


@pytest.fixture
def publisher() -> ListPublisher:
    return ListPublisher()


@pytest.fixture
def robot(publisher: ListPublisher, tmp_path: Path) -> ListReader:
    return ListReader(tmp_path / "lists", publisher.ask, publisher.files["1.root.json"])


# ----------------------------------------------------------------------------------------------------------------- attacks


def unsigned(data: bytes) -> bytes:
    return json.dumps(json.loads(data) | {"signatures": []}).encode()


def unsigned_file(lists: ListPublisher, role: str) -> None:
    lists.renew(role)
    lists.write(role, unsigned)


def file_of_another_version(lists: ListPublisher, role: str) -> None:
    lists.renew(role)
    lists.files[lists.file(role)] = lists.files[f"2.{role}.json"]


def file_of_another_hash(lists: ListPublisher, role: str) -> None:
    lists.publish(role)
    above = lists.timestamp.snapshot_meta if role == "snapshot" else lists.snapshot.meta[f"{role}.json"]
    above.hashes = {"sha256": "0" * 64}
    lists.publish(*ABOVE[role])


def file_withheld(lists: ListPublisher, role: str) -> None:
    lists.renew(role)
    del lists.files[lists.file(role)]


def older_version(lists: ListPublisher, role: str) -> None:
    lists.signed(role).version = 1
    lists.name(role)
    lists.write(role)
    lists.publish(*ABOVE.get(role, ()))


def role_removed(lists: ListPublisher, role: str) -> None:
    del lists.snapshot.meta[f"{role}.json"]
    lists.publish("snapshot", "timestamp")


def expired(lists: ListPublisher, role: str) -> None:
    lists.signed(role).expires = days(-5)
    lists.renew(role)


def signed_by_the_key_before(lists: ListPublisher, role: str) -> None:
    before = lists.keys[role]
    lists.rotate(role)
    lists.keys[role] = before
    lists.publish("root")
    lists.renew(role)


def key_of_the_site_revoked(lists: ListPublisher, _: str) -> None:
    """The last list, which the robot holds, is not believed any more."""
    lists.targets.revoke_key(lists.keys[ROLE][0].public_key.keyid, ROLE)
    lists.targets.add_key(CryptoSigner.generate_ed25519().public_key, ROLE)
    lists.renew("targets")


def site_not_delegated(lists: ListPublisher, _: str) -> None:
    """Its last list lies in the robot's folder, well signed and not expired."""
    lists.targets.delegations.roles.clear()
    lists.targets.delegations.keys.clear()
    lists.renew("targets")


SIGNATURE, FREEZE, ROLLBACK = "signature: ", "freeze: ", "rollback: "


@pytest.mark.parametrize(
    ("attack", "roles", "kind"),
    [
        (unsigned_file, (*TOP, ROLE), SIGNATURE),
        (file_of_another_version, ("root", "snapshot", "targets", ROLE), ""),
        (file_of_another_hash, ("snapshot", "targets", ROLE), SIGNATURE),
        (file_withheld, ("timestamp", "snapshot", "targets", ROLE), FREEZE),
        (older_version, ("timestamp", "snapshot", "targets", ROLE), ROLLBACK),
        (role_removed, ("targets", ROLE), SIGNATURE),
        (expired, ("timestamp", "snapshot", "targets", ROLE), FREEZE),
        (signed_by_the_key_before, ("timestamp", "snapshot", "targets"), SIGNATURE),
        (key_of_the_site_revoked, (ROLE,), SIGNATURE),
        (site_not_delegated, (ROLE,), f"{SIGNATURE}no key may sign maps of site {SITE}; "),
    ],
)
def test_what_must_not_be_believed(
    tmp_path: Path, attack: Callable[[ListPublisher, str], None], roles: tuple[str, ...], kind: str
) -> None:
    """Nothing new is run, the file that was believed before stays, and honest lists are believed again."""
    for role in roles:
        lists = ListPublisher()
        robot = ListReader(tmp_path / role, lists.ask, lists.files["1.root.json"])
        lists.renew(role)
        assert robot.refused() == "", "the control"
        attack(lists, role)
        refused = robot.refused()
        assert refused and refused.startswith(kind), (role, refused)
        assert robot.number(role) == 2


@pytest.mark.parametrize("role", [*TOP, ROLE])
def test_files_that_are_larger_than_any_honest_one(
    publisher: ListPublisher, robot: ListReader, role: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Well signed, with blanks behind it."""
    limit = {"root": 64_000, "timestamp": 4_000, "snapshot": 64_000}.get(role, 256_000)
    publisher.renew(role)
    publisher.files[publisher.file(role)] = publisher.files[publisher.file(role)].ljust(limit + 1)
    assert robot.refused().startswith("size: ")
    assert robot.number(role) in (None, 1)
    limits = {f"{kind}_max_length": 1 << 20 for kind in TOP}
    monkeypatch.setattr(tuf_client, "CLIENT_LIMITS", replace(tuf_client.CLIENT_LIMITS, **limits))
    assert robot.refused() == "", "the control"


def test_large_sites_and_old_robots_fit(publisher: ListPublisher, robot: ListReader) -> None:
    """A list of a hundred sites, and 200 roots since the robot was made."""
    roles = publisher.targets.delegations.roles
    for number in range(100):
        name, keys = f"site-place-{number:056d}", list(roles[ROLE].keyids)
        roles[name] = tuf.DelegatedRole(name, keys, 1, terminating=True, paths=[f"{number}/*/m"])
    publisher.renew("targets")
    for _ in range(199):
        publisher.publish("root")
    assert robot.refused() == ""
    assert (robot.number("root"), len(publisher.files["2.targets.json"]) < 256_000) == (200, True)


def test_over_a_bus_answers_without_end_and_refusals_are_told(publisher: ListPublisher, tmp_path: Path) -> None:
    """More bytes behind every answer, or one byte in each."""
    drip = Mock(return_value=encode_message(Part(total_bytes=1 << 40, offset=0, data=b"x")))
    hub, refuse = MemoryHub(), Mock(side_effect=LinkError("not now"))
    with MemoryBus(hub) as server, MemoryBus(hub) as bus:
        for answer, said in ((drip, "size: "), (refuse, "not now")):
            handle = server.queryable(robot_key("*", "*", "trust/*"), answer)
            robot = ListReader(tmp_path / said, ask_over(bus, SITE, "r1", 0.3), publisher.files["1.root.json"])
            assert said in robot.refused()
            handle.close()
    assert drip.call_count == 1


# -------------------------------------------------------------------------------------------------------- roots and first use


def test_no_more_is_asked_than_is_needed(publisher: ListPublisher, robot: ListReader) -> None:
    assert robot.refused() == ""
    assert publisher.asked == ["2.root.json", "timestamp.json", "1.snapshot.json", "1.targets.json", f"1.{ROLE}.json"]
    publisher.asked.clear()
    assert robot.refused() == ""
    assert publisher.asked == ["2.root.json", "timestamp.json"]


@pytest.mark.parametrize("root", [b"", b"{}", b"\xff" * 100, b"[" * 5000, None])
def test_a_first_root_that_is_none(publisher: ListPublisher, tmp_path: Path, root: bytes | None) -> None:
    given = unsigned(publisher.files["1.root.json"]) if root is None else root
    assert ListReader(tmp_path, publisher.ask, given).refused().startswith(SIGNATURE)


@pytest.mark.parametrize(
    ("new", "signers", "is_good"), [(1, [1], True), (2, [1, 2], True), (2, [2], False), (2, [1], False)]
)
def test_root_rotation(
    publisher: ListPublisher, robot: ListReader, new: int, signers: list[int], is_good: bool
) -> None:
    """The key of the old root (1) and of the new one sign it."""
    people = {number: CryptoSigner.generate_ed25519() for number in (1, 2)}
    begun, own = publisher.keys["root"], publisher.root.roles["root"]
    own.keyids.clear()
    publisher.root.add_key(people[1].public_key, "root")
    publisher.keys["root"] = [*begun, people[1]]
    publisher.publish("root")
    assert robot.refused() == ""
    own.keyids.clear()
    publisher.root.add_key(people[new].public_key, "root")
    publisher.keys["root"] = [people[number] for number in signers]
    publisher.publish("root")
    assert (robot.refused() == "") is is_good
    assert robot.number("root") == (3 if is_good else 2)


def test_first_use_pins_the_root(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first, other = ListPublisher(), ListPublisher()
    assert ListReader(tmp_path, first.ask, None).refused() == ""
    assert "first use" in caplog.text
    refused = ListReader(tmp_path, other.ask, None).refused()
    says = f"if the server's store was recreated, remove {tmp_path}; else another server replies instead"
    assert refused.startswith(SIGNATURE) and refused.endswith(says)
    # The control: whoever comes first is believed.
    assert ListReader(tmp_path / "fresh", other.ask, None).refused() == ""


def test_silence_is_no_end_of_the_roots(robot: ListReader) -> None:
    """Nobody answers: nothing new, not even by what is on the disk, and the next question works again."""
    assert robot.refused() == ""
    robot.trust._ask = Mock(side_effect=UnreachableError("no reply"))
    robot.trust.refresh()
    with pytest.raises(UnreachableError):
        robot.trust.admitted(wanted(1))
    robot.start()
    assert robot.refused() == ""


# ------------------------------------------------------------------------------------------------------- the list of the site


def test_the_wanted_version_must_be_in_the_list(publisher: ListPublisher, robot: ListReader) -> None:
    """Attack: a forged `wanted`, an older version that is not admitted any more, another manifest under an admitted number."""
    publisher.admit(16, 17)
    publisher.site.targets["hall/17/manifest.json"].unrecognized_fields["custom"]["note"] = "of a newer server"
    publisher.renew(ROLE)
    assert (robot.refused(16), robot.refused(17)) == ("", "")
    assert robot.refused(99).startswith("signature: version 99 ")
    assert robot.refused(3).startswith("rollback: version 3 ")
    forged = WantedVersion(site=SITE, version=17, manifest_sha256=sha256_hex(b"manifest 99"))
    with pytest.raises(UntrustedError, match=r"^signature: version 17 "):
        robot.trust.admitted(forged)


def test_a_site_speaks_for_itself_alone(publisher: ListPublisher, robot: ListReader) -> None:
    publisher.site.targets.clear()
    publisher.renew(ROLE)
    assert "admits none" in robot.refused()
    publisher.site.delegations = publisher.targets.delegations  # nor lets it others speak in its place
    publisher.renew(ROLE)
    assert robot.refused() != ""
    publisher.site.delegations = None
    publisher.admit(1)
    target = publisher.site.targets.pop("hall/1/manifest.json")
    target.path = "yard/1/manifest.json"
    publisher.site.targets[target.path] = target
    publisher.renew(ROLE)
    assert robot.refused().startswith(SIGNATURE)


# ------------------------------------------------------------------------------------------------------------------ clocks


@pytest.mark.parametrize("role", ["root", "timestamp"])
def test_what_the_robot_holds_has_expired(publisher: ListPublisher, robot: ListReader, role: str) -> None:
    """And what it is given has not."""
    publisher.signed(role).expires = days(0.5)
    publisher.publish(role)
    assert robot.refused() == ""
    robot.ahead_s = 0.75 * DAY_S
    assert robot.refused().startswith(FREEZE)  # the control
    publisher.signed(role).expires = days(2)
    publisher.publish(role)
    assert robot.refused() == ""


def test_a_clock_far_ahead_makes_all_expired_until_it_is_right(robot: ListReader) -> None:
    assert robot.refused() == ""
    robot.ahead_s = 30 * DAY_S
    robot.start()
    assert robot.refused().startswith(FREEZE)
    robot.ahead_s = 0.0
    robot.start()
    assert robot.refused() == ""
    # The control: a moment that no timestamp went with would keep the robot out for a month.
    (robot.folder / "clock").write_text(f"{time.time()} {time.time() + 30 * DAY_S} 99")
    robot.start()
    assert robot.refused().startswith(FREEZE)


def test_a_site_whose_clocks_were_a_year_ahead_goes_on_once_they_are_right(
    publisher: ListPublisher, robot: ListReader, caplog: pytest.LogCaptureFixture
) -> None:
    """Server and robot; a robot of before had noted that clock alone, and was frozen for a year."""
    signed: list[dict[str, bytes]] = []
    for ahead_days in (0, 200, 0):  # 200: root and targets still last, by either clock
        for role, lasts in (("snapshot", 7), ("timestamp", 1), (ROLE, 14)):
            publisher.signed(role).expires = days(ahead_days + lasts)
        publisher.renew(ROLE)
        robot.ahead_s = ahead_days * DAY_S
        robot.start()
        assert robot.refused() == ""
        signed.append(dict(publisher.files))
    assert "the latter is believed" in caplog.text
    # What was signed by the wrong clock is worth nothing any more, however long it says to last.
    publisher.files = signed[1]
    assert robot.refused().startswith(ROLLBACK)
    publisher.renew(ROLE)
    (robot.folder / "clock").write_text(str(time.time() + 200 * DAY_S))
    robot.start()
    assert robot.refused() == "", "a robot that noted its clock before it knew of signed moments"


def test_a_clock_set_back_revives_nothing(publisher: ListPublisher, robot: ListReader) -> None:
    """Believed at day 0.9; a timestamp that ended at day 0.5 stays expired although the clock says day 0 again."""
    publisher.timestamp.expires = days(0.5)
    publisher.publish("timestamp")
    replayed = dict(publisher.files)
    assert robot.refused() == ""  # the control: it is valid by the clock
    publisher.timestamp.expires = days(2)
    publisher.publish("timestamp")
    robot.ahead_s = 0.9 * DAY_S
    assert robot.refused() == ""
    robot.ahead_s = 0.0
    robot.start()
    # Where robots forget a number, such as after another online key, only the clock stands against the replay.
    (robot.folder / "timestamp.json").unlink()
    publisher.files = replayed
    assert robot.refused().startswith("freeze: timestamp expired")
    (robot.folder / "clock").unlink()  # the control: without what it remembers the replay is believed
    robot.start()
    assert robot.refused() == ""
