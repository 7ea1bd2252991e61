"""What a store signs: after each release, before something expires, never what robots would refuse; and what the server tells robots."""

import fcntl
import os
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from securesystemslib.signer import CryptoSigner

from fleetmap.errors import StateError, StoreError, UntrustedError, UsageError
from fleetmap.messages import RobotHealth, WantedVersion
from mapserver import releases
from mapserver.api.metrics import Metrics
from mapserver.fleet.alerts import AlertSettings, active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.store import MapStore
from mapserver.trust import KeyFolder, SignedLists, init_here, prepare_lists, signing, update_lists
from mapserver.trust.keys import load_key, make_key, make_passphrase
from mapserver.trust.repository import ListRepository
from mapserver.trust.signing import check_base, sign_files, verify_files
from mapserver.trust.status import trust_status
from support.storage.clock import Clock
from support.storage.map_samples import publish_samples, save_sample_draft

HOUR_NS = 3_600_000_000_000
REPORT = {"acceptance.json": b"{}", "acceptance.html": b"<p>"}


@pytest.fixture
def clock() -> Clock:
    return Clock(1_780_000_000_000_000_000)


@pytest.fixture
def store(store: MapStore) -> MapStore:
    publish(store, seed=1)
    init_here(store)
    return store


def publish(store: MapStore, seed: int) -> int:
    save_sample_draft(store, seed=seed)
    return releases.publish(store, "lab")


def told(store: MapStore, version: int) -> int | None:
    info = store.version("lab", version)
    wanted = WantedVersion(site="lab", version=version, manifest_sha256=info.manifest_sha256)
    return SignedLists(store.folder).admitted_or_current(wanted).version


def states(store: MapStore) -> dict[int, str]:
    found = SignedLists(store.folder).served("lab")
    return {entry.about.version: entry.about.state for entry in found.admitted}


def test_every_release_is_signed_at_once(store: MapStore) -> None:
    assert states(store) == {1: "current"}
    assert publish(store, seed=2) == 2
    assert states(store) == {1: "previous", 2: "current"}
    save_sample_draft(store, seed=3)
    canary = releases.start_canary(store, "lab", 3, 0.5)
    assert states(store) == {1: "previous", 2: "current", 3: "trial"}
    releases.end_canary(store, canary, promote=False, outcome="worse")
    assert states(store) == {1: "previous", 2: "current"}
    releases.roll_back(store, "lab")
    assert states(store) == {1: "current"}  # the version that was taken back may not be run any more
    releases.promote(store, "lab", 2)
    assert states(store) == {1: "previous", 2: "current"}
    found = SignedLists(store.folder).served("lab")
    info = store.version("lab", 2)
    assert found.state("current").length == info.manifest_bytes
    assert found.state("current").about.vocabulary == info.vocabulary_sha256


def test_robots_are_told_of_what_is_signed_alone(store: MapStore) -> None:
    """A process that cannot read the site's key: what was published waits for the server, and robots stay where they are."""
    own = store.folder / "keys" / "site-lab.pem"
    own.rename(store.folder / "elsewhere.pem")
    assert publish(store, seed=2) == 2
    assert (states(store), told(store, 2)) == ({1: "current"}, 1)
    (store.folder / "elsewhere.pem").rename(own)
    update_lists(store)
    assert told(store, 2) == 2


def test_nothing_is_told_before_the_first_list(tmp_path: Path, clock: Clock) -> None:
    with MapStore.open(tmp_path / "store", create=True, clock_ns=clock) as store:
        publish(store, seed=1)
        assert told(store, 1) == 1  # a store that is not signed serves as before
        path, words = signing.init_offline(store, tmp_path / "stick")
        assert told(store, 1) is None
        assert trust_status(store).faults == ["site lab: no key may sign its maps; `mapserver trust admit lab`"]
        signing.admit_site(store, "lab", load_key(path, words))
        assert (told(store, 1), trust_status(store).faults) == (1, [])


def test_two_servers_do_not_make_the_keys_of_a_store_at_once(tmp_path: Path, clock: Clock, monkeypatch) -> None:
    made = []

    def make(keys: KeyFolder, name: str) -> CryptoSigner:
        with (lists / "lock").open() as lock, pytest.raises(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        made.append(name)
        return make_key(keys.path(name), None)

    monkeypatch.setattr(KeyFolder, "make", make)
    with MapStore.open(tmp_path / "store", create=True, clock_ns=clock) as store:
        lists = SignedLists(store.folder).folder
        init_here(store)
        with pytest.raises(StateError, match="already has signed lists"):
            init_here(store)
    assert made == ["root", "online"]


def test_lists_are_signed_anew_before_they_end(store: MapStore, clock: Clock, monkeypatch) -> None:
    lists = SignedLists(store.folder)

    def numbers() -> tuple[int, int, int]:
        return lists.read("timestamp").version, lists.newest("snapshot"), lists.newest("site-lab")

    before = numbers()
    clock.now_ns += 5 * HOUR_NS
    update_lists(store)
    assert numbers() == before
    clock.now_ns += 2 * HOUR_NS
    update_lists(store)
    assert numbers() == (before[0] + 1, *before[1:])
    clock.now_ns += 20 * HOUR_NS  # a night later
    update_lists(store)
    assert numbers() == (before[0] + 2, before[1] + 1, before[2] + 1)
    clock.now_ns += 5 * 24 * HOUR_NS
    update_lists(store)
    assert trust_status(store).faults == []
    clock.now_ns += 2 * 24 * HOUR_NS
    assert trust_status(store).faults[0].startswith("timestamp: expired")
    update_lists(store)
    assert trust_status(store).faults == []
    clock.now_ns += 700 * 24 * HOUR_NS
    update_lists(store)
    assert [words.partition(":")[0] for words in trust_status(store).faults] == ["root", "targets"]
    clock.now_ns += 700 * 24 * HOUR_NS
    monkeypatch.setattr(SignedLists, "is_signed", lambda *_: False)
    ids = [alert.id for alert in active_alerts(store, Fleet(store), AlertSettings(), clock())]
    assert {"FleetmapTrustFault/site-lab", "FleetmapTrustFault/list of site-lab"} < set(ids)
    assert len(set(ids)) == len(ids), "each is acknowledged by itself"


def test_old_lists_are_removed_and_roots_are_not(store: MapStore) -> None:
    for seed in range(2, 10):
        publish(store, seed=seed)
    names = [path.name for path in (store.folder / "trust").glob("*.json")]
    assert sum(name.endswith(".site-lab.json") for name in names) == 5
    assert "1.root.json" in names


def test_another_key_than_the_root_key_changes_nothing(store: MapStore) -> None:
    thief = CryptoSigner.generate_ed25519()
    before = {path: path.read_bytes() for path in store.folder.glob("[kt]*/*.*")}
    for act in (signing.rotate_online, signing.rotate_root):
        with pytest.raises(StateError, match="is not the root key of"):
            act(store, thief)
    for act in (signing.admit_site, signing.revoke_site):
        with pytest.raises(StateError, match="is not the root key of"):
            act(store, "lab", thief)
    repository = ListRepository(store.folder, datetime.fromtimestamp(store.now_ns() / 1e9, UTC))
    for sign in (
        lambda: repository.sign_site("lab", signing.admitted_versions(store.releases("lab")), thief),
        lambda: repository.delegate("lab", thief.public_key, thief),
        lambda: repository.replace_root(thief, thief),
        lambda: repository.sign_online(thief),
    ):
        with pytest.raises(StateError, match="not signed as robots require"):
            sign()
    assert {path: path.read_bytes() for path in store.folder.glob("[kt]*/*.*")} == before


def test_the_root_key_goes_from_this_machine_to_a_stick(store: MapStore, tmp_path: Path) -> None:
    keys, lists = KeyFolder(store.folder / "keys"), SignedLists(store.folder)
    first = keys.signer("root")
    path, words = signing.rotate_root(store, first, tmp_path / "stick")
    assert (path.name, lists.newest("root"), keys.has("root")) == ("root-2.pem", 2, False)
    with pytest.raises(StateError, match="is not the root key"):
        signing.rotate_online(store, first)
    own = load_key(path, words)
    assert signing.rotate_root(store, own) is None  # the same key, for two more years
    signing.rotate_online(store, own)
    publish(store, seed=2)
    assert (states(store), lists.newest("root")) == ({1: "previous", 2: "current"}, 4)
    with pytest.raises(UsageError, match="no key may sign maps of site yard"):
        signing.revoke_site(store, "yard", own)


def test_a_key_that_is_elsewhere_signs_nothing_until_the_site_is_admitted_again(store: MapStore) -> None:
    root_key = KeyFolder(store.folder / "keys").signer("root")
    prepare_lists(store, "tcp/127.0.0.1:0")  # the control
    (store.folder / "keys" / "site-lab.pem").unlink()
    with pytest.raises(UsageError, match=r"site lab is not .*/site-lab.pem .*trust admit lab --key ROOT"):
        prepare_lists(store, "tcp/127.0.0.1:0")
    publish(store, seed=2)
    assert states(store) == {1: "current"}
    signing.admit_site(store, "lab", root_key)
    prepare_lists(store, "tcp/127.0.0.1:0")
    assert states(store) == {1: "previous", 2: "current"}


def test_row_33_an_archive_swapped_in_the_database(store: MapStore) -> None:
    """The next map would be built on it. A list named the right one, and none is signed that names the other."""
    check_base(store, store.current("lab"))
    set_archive(store, store._blobs.put(b"another survey"))
    assert store.archive("lab", 1) == b"another survey"  # the control: the store believes its table
    for act in (lambda: check_base(store, store.current("lab")), lambda: update_lists(store)):
        with pytest.raises(StateError, match="names other bytes for version 1"):
            act()
    set_archive(store, None)  # as `gc` removes it
    check_base(store, store.current("lab"))
    update_lists(store)


def set_archive(store: MapStore, sha256: str | None) -> None:
    with store._database.write() as connection:
        connection.execute("UPDATE versions SET archive_sha256 = ? WHERE version = 1", (sha256,))


@pytest.mark.parametrize(
    "name",
    ["../store.sqlite3", "keys/online.pem", "1.site-yard.json", "", "x" * 300, "lock", "2.root.json", "1.root.json.x"],
)
def test_nothing_but_the_sites_own_lists_is_given_out(store: MapStore, name: str) -> None:
    (store.folder / "trust" / "1.site-yard.json").write_bytes(b"{}")
    lists = SignedLists(store.folder)
    assert lists.file("lab", name) == b""
    assert lists.file("lab", "1.root.json") != b""
    assert lists.file("yard", "1.site-yard.json") == b"{}"


def test_beyond_loopback_a_store_must_be_signed_first(tmp_path: Path, clock: Clock) -> None:
    with MapStore.open(tmp_path / "store", create=True, clock_ns=clock) as store:
        publish_samples(store, 1, first=1)
        with pytest.raises(UsageError, match="trust init --here"):
            prepare_lists(store, "tls/0.0.0.0:7447")
        prepare_lists(store, "tcp/127.0.0.1:7447")
        assert states(store) == {1: "current"}
        prepare_lists(store, "tls/0.0.0.0:7447")
        with pytest.raises(StateError, match="already"):
            init_here(store)


def test_a_new_site_is_signed_for_by_itself_where_the_root_is_here(store: MapStore) -> None:
    publish_samples(store, 1, first=5, site="yard")
    assert SignedLists(store.folder).served("yard").state("current").about.version == 1
    assert len(trust_status(store).risks) == 3


def test_keys_are_for_their_owner_and_encrypted(tmp_path: Path, monkeypatch) -> None:
    words = make_passphrase()
    assert len(words.replace("-", "")) * 5 == 80
    path = tmp_path / "keys" / "root-ada.pem"
    key = make_key(path, words)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert b"ENCRYPTED" in path.read_bytes()
    assert load_key(path, words).public_key == key.public_key
    for wrong in (None, make_passphrase()):
        with pytest.raises(UsageError, match="passphrase"):
            load_key(path, wrong)
    for place, reason in ((path, "never overwritten"), (tmp_path / ("k" * 300), "cannot be written")):
        with pytest.raises(StoreError, match=reason):
            make_key(place, words)
    (tmp_path / "credentials").mkdir()
    (tmp_path / "credentials" / "fleetmap-online").write_text(words + "\n")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path / "credentials"))
    keys = KeyFolder(tmp_path / "keys")
    made = keys.make("online")
    assert b"ENCRYPTED" in (tmp_path / "keys" / "online.pem").read_bytes()
    assert keys.signer("online").public_key == made.public_key
    assert keys.signer("site-lab") is None
    assert keys.replace("online").public_key != made.public_key
    assert len(list((tmp_path / "keys").glob("online*.old"))) == 1


def test_damaged_lists_do_not_undo_a_release(store: MapStore, caplog) -> None:
    """Robots stay on the version before, and the server says why, at every attempt."""
    (store.folder / "trust" / "timestamp.json").write_text("{")
    assert publish(store, seed=2) == 2
    assert "not signed" in caplog.text
    assert store.current("lab").version == 2
    with pytest.raises(StoreError, match="restore the store's folder trust"):
        update_lists(store)


def test_one_sites_fault_does_not_stop_the_others(store: MapStore, clock: Clock) -> None:
    """Somebody wrote into the database: the other sites' lists and the timestamp are signed all the same."""
    publish_samples(store, 1, first=5, site="yard")
    lists = SignedLists(store.folder)
    with store._database.write() as connection:
        connection.execute("UPDATE versions SET vocabulary_sha256 = ? WHERE site = 'lab'", ("0" * 64,))
    before = lists.newest("site-lab"), lists.newest("site-yard"), lists.read("timestamp").version
    clock.now_ns += 30 * HOUR_NS
    with pytest.raises(StateError, match="names other bytes for version 1 of site lab"):
        update_lists(store)
    after = lists.newest("site-lab"), lists.newest("site-yard"), lists.read("timestamp").version
    assert after == (before[0], before[1] + 1, before[2] + 1)


def test_lists_of_a_clock_that_was_ahead_are_signed_anew(store: MapStore, clock: Clock) -> None:
    """Else a timestamp of that day would be believed for years, whoever shows it."""
    clock.now_ns += 3650 * 24 * HOUR_NS
    update_lists(store)
    clock.now_ns -= 3650 * 24 * HOUR_NS
    update_lists(store)
    lists, now = SignedLists(store.folder), datetime.fromtimestamp(clock() / 1e9, UTC)
    for role, days in (("timestamp", 1), ("snapshot", 7), ("site-lab", 14)):
        assert now < lists.read(role).expires <= now + timedelta(days=days), role


def test_what_else_lies_in_the_folder_of_lists(store: MapStore, tmp_path: Path) -> None:
    """A copy that somebody made by hand does not end signing; a link to elsewhere is not read for anybody."""
    folder, lists = store.folder / "trust", SignedLists(store.folder)
    (folder / "old.7.site-lab.json").write_text("{}")
    publish(store, seed=2)
    assert states(store) == {1: "previous", 2: "current"}
    (tmp_path / "secret").write_text("{}")
    (folder / "77.root.json").symlink_to(tmp_path / "secret")
    (folder / "pipe").mkdir()
    assert lists.file("lab", "77.root.json") == b""
    os.mkfifo(folder / "78.root.json")
    assert lists.file("lab", "78.root.json") == b"", "a pipe would stop the server"
    (folder / "77.root.json").unlink()
    (folder / "9.snapshot.json").symlink_to(tmp_path / "secret")
    assert any("trust" in fault and "symbolic link" in fault for fault in store.verify().faults)


def test_metrics_say_how_long_the_lists_last(store: MapStore, clock: Clock) -> None:
    fleet = Fleet(store, clock_ns=clock)
    for robot, hours in (("r1", 0.5), ("r2", 31.0), ("r3", None)):
        about = {"status": "TRACKING", "metrics": {"map_word_hours": hours}}
        fleet.take_health("lab", robot, RobotHealth(site="lab", robot=robot, stamp_ns=1, version=1, **about))

    def figures() -> dict[str, float]:
        lines = Metrics(store, fleet).text().decode().splitlines()
        return {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in lines if line[0] != "#"}

    found = figures()
    assert found['fleetmap_site_map_word_hours_max{site="lab"}'] == 31.0
    for role, days in (("root", 730.0), ("targets", 365.0), ("timestamp", 1.0), ("site-lab", 14.0)):
        assert found[f'fleetmap_trust_days_left{{role="{role}"}}'] == days
    assert found["fleetmap_trust_faults"] == 0
    clock.now_ns += 8 * 24 * HOUR_NS
    found = figures()
    assert found['fleetmap_trust_days_left{role="timestamp"}'] == -7.0
    assert found["fleetmap_trust_faults"] == 3  # timestamp, snapshot, and the site's list
    (store.folder / "trust" / "timestamp.json").write_text("{")
    assert figures()["fleetmap_trust_faults"] == 1


def test_signed_files_are_verified_and_changed_ones_refused(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "a", create=True) as store, MapStore.open(tmp_path / "b", create=True) as other:
        assert sign_files(store, REPORT) is None  # no lists yet
        for each in (store, other):
            init_here(each)
        signature = sign_files(store, REPORT)
        assert verify_files(store, signature, REPORT).startswith("20")
        for files in (
            REPORT | {"acceptance.json": b"{ }"},
            {"acceptance.json": b"{}"},
            REPORT | {"acceptance.pdf": b""},
        ):
            with pytest.raises(UntrustedError, match="is not the file that was signed"):
                verify_files(store, signature, files)
        for wrong in (sign_files(other, REPORT), b"[]", b"{", b"{}", signature.replace(b'"sig": "', b'"sig": "AAAA')):
            with pytest.raises(UntrustedError, match="online key"):
                verify_files(store, wrong, REPORT)
        (store.folder / "keys" / "online.pem").unlink()
        assert sign_files(store, REPORT) is None
