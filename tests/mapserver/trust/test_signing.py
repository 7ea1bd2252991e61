"""What a store signs: after each release, before something expires, never what robots would refuse; and what the server tells robots."""

import os
import stat
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from securesystemslib.signer import CryptoSigner

from fleetmap.errors import StateError, StoreError, UsageError
from fleetmap.messages import RobotHealth, WantedVersion
from mapserver import releases
from mapserver.api.metrics import Metrics
from mapserver.fleet.fleet import Fleet
from mapserver.store import MapStore
from mapserver.trust import KeyFolder, SignedLists, ceremonies, init_here, prepare_lists, update_lists
from mapserver.trust.keys import load_key, make_passphrase, new_key, save_key
from mapserver.trust.repository import ListRepository
from mapserver.trust.signing import admitted_versions
from mapserver.trust.status import trust_status
from support.storage.map_samples import save_sample_draft

HOUR_NS = 3_600_000_000_000


class Clock:
    def __init__(self) -> None:
        self.now_ns = 1_780_000_000_000_000_000

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[MapStore]:
    with MapStore.open(tmp_path / "store", create=True, clock_ns=clock) as made:
        publish(made, seed=1)
        init_here(made)
        yield made


def publish(store: MapStore, seed: int) -> int:
    save_sample_draft(store, seed=seed)
    return releases.publish(store, "lab")


def told(store: MapStore, version: int) -> int | None:
    info = store.version("lab", version)
    wanted = WantedVersion(site="lab", version=version, manifest_sha256=info.manifest_sha256)
    return SignedLists(store.folder).admitted_or_current(wanted).version


def states(store: MapStore) -> dict[int, str]:
    found = SignedLists(store.folder).served("lab")
    assert found is not None
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
    assert found is not None
    assert found.state("current").length == info.manifest_bytes
    assert found.state("current").about.vocabulary == info.vocabulary_sha256


def test_without_predecessors_a_rollback_needs_the_signer(store: MapStore) -> None:
    publish(store, seed=2)
    rows = store.releases("lab")
    assert [entry.about.version for entry in admitted_versions(rows, 1)] == [1, 2]
    assert [entry.about.version for entry in admitted_versions(rows, 0)] == [2]


def test_robots_are_told_of_what_is_signed_alone(store: MapStore) -> None:
    """The builder's key is elsewhere: what was published waits for it, and robots stay where they are."""
    (store.folder / "keys" / "site-lab.pem").rename(store.folder / "elsewhere.pem")
    (store.folder / "keys" / "root.pem").unlink()
    assert publish(store, seed=2) == 2
    assert states(store) == {1: "current"}
    assert told(store, 2) == 1
    (store.folder / "elsewhere.pem").rename(store.folder / "keys" / "site-lab.pem")
    update_lists(store)
    assert told(store, 2) == 2


def test_nothing_is_told_before_the_first_list(tmp_path: Path, clock: Clock) -> None:
    with MapStore.open(tmp_path / "store", create=True, clock_ns=clock) as store:
        save_sample_draft(store, seed=1)
        releases.publish(store, "lab")
        assert told(store, 1) == 1  # a store that is not signed serves as before
        people = [CryptoSigner.generate_ed25519() for _ in range(3)]
        online = KeyFolder(store.folder / "keys").make("online")
        ListRepository(SignedLists(store.folder), datetime.now(UTC)).init(people, 2, online.public_key)
        update_lists(store)
        assert told(store, 1) is None
        assert trust_status(store).faults == ["site lab: no key may sign its maps; `mapserver trust admit lab`"]


def test_lists_are_signed_anew_before_they_end(store: MapStore, clock: Clock) -> None:
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


def test_old_lists_are_removed_and_roots_are_not(store: MapStore) -> None:
    for seed in range(2, 10):
        publish(store, seed=seed)
    names = [path.name for path in (store.folder / "trust").glob("*.json")]
    assert sum(name.endswith(".site-lab.json") for name in names) == 5
    assert "1.root.json" in names


def test_the_server_takes_no_list_that_robots_would_refuse(store: MapStore, clock: Clock) -> None:
    """Of a thief with another key, with a number that was there, or under a root that one of two people signed."""
    lists, thief = SignedLists(store.folder), CryptoSigner.generate_ed25519()
    repository = ListRepository(lists, datetime.fromtimestamp(clock() / 1e9, UTC))
    admitted = admitted_versions(store.releases("lab"), 1)
    with pytest.raises(StateError, match="not signed as robots demand"):
        repository.accept_site("lab", repository.sign_site("lab", admitted, [thief]))
    own = KeyFolder(store.folder / "keys").signer("site-lab")
    signed = repository.sign_site("lab", admitted, [own])
    repository.accept_site("lab", signed)  # the control
    with pytest.raises(StateError, match="3 is the next"):
        repository.accept_site("lab", signed)
    with pytest.raises(StateError, match="not signed"):
        repository.delegate("lab", [thief.public_key], [thief])
    with pytest.raises(StateError, match="not signed"):
        repository.replace_online(thief.public_key, [thief])
    with pytest.raises(StateError, match="not signed"):
        repository.sign_online(thief)
    assert lists.newest("root") == 1


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
        save_sample_draft(store, seed=1)
        releases.publish(store, "lab")
        with pytest.raises(UsageError, match="trust init --here"):
            prepare_lists(store, "tls/0.0.0.0:7447")
        prepare_lists(store, "tcp/127.0.0.1:7447")
        assert states(store) == {1: "current"}
        prepare_lists(store, "tls/0.0.0.0:7447")
        with pytest.raises(StateError, match="already"):
            init_here(store)


def test_a_new_site_is_signed_for_by_itself_where_the_root_is_here(store: MapStore) -> None:
    save_sample_draft(store, site="yard", seed=5)
    releases.publish(store, "yard")
    found = SignedLists(store.folder).served("yard")
    assert found is not None
    assert found.state("current").about.version == 1
    assert len(trust_status(store).risks) == 3


def test_keys_are_for_their_owner_and_encrypted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = make_passphrase()
    assert len(words.replace("-", "")) * 5 == 80
    key = new_key()
    path = tmp_path / "keys" / "root-ada.pem"
    save_key(path, key, words)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert b"ENCRYPTED" in path.read_bytes()
    assert load_key(path, words).public_key == key.public_key
    for wrong in (None, make_passphrase()):
        with pytest.raises(UsageError, match="passphrase"):
            load_key(path, wrong)
    with pytest.raises(StoreError, match="never overwritten"):
        save_key(path, key, words)
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


def test_damaged_lists_do_not_undo_a_release(store: MapStore, caplog: pytest.LogCaptureFixture) -> None:
    """Robots stay on the version before, and the server says why, at every attempt."""
    (store.folder / "trust" / "timestamp.json").write_text("{")
    assert publish(store, seed=2) == 2
    assert "not signed" in caplog.text
    assert store.current("lab").version == 2
    with pytest.raises(StoreError, match="restore the store's folder trust"):
        update_lists(store)


def test_one_sites_fault_does_not_stop_the_others(store: MapStore, clock: Clock) -> None:
    """Somebody wrote into the database: the other sites' lists and the timestamp are signed all the same."""
    save_sample_draft(store, site="yard", seed=5)
    releases.publish(store, "yard")
    lists = SignedLists(store.folder)
    with store._transactions.write() as connection:
        connection.execute("UPDATE versions SET vocabulary_sha256 = ? WHERE site = 'lab'", ("0" * 64,))
    before = lists.newest("site-lab"), lists.newest("site-yard"), lists.read("timestamp").version
    clock.now_ns += 30 * HOUR_NS
    with pytest.raises(StateError, match="names other bytes for version 1 of site lab"):
        update_lists(store)
    after = lists.newest("site-lab"), lists.newest("site-yard"), lists.read("timestamp").version
    assert after == (before[0], before[1] + 1, before[2] + 1)


def test_a_ceremony_that_cannot_be_finished_changes_no_key(store: MapStore) -> None:
    people = [KeyFolder(store.folder / "keys").signer("root")]
    before = (store.folder / "keys" / "site-lab.pem").read_bytes()
    with pytest.raises(UsageError, match="--threshold 2"):
        ceremonies.admit(store, "lab", [], people, threshold=2, previous=1)
    assert (store.folder / "keys" / "site-lab.pem").read_bytes() == before
    with pytest.raises(UsageError, match="holds no root key"):
        ceremonies.rotate_root(store, people, removed=[new_key().public_key])
    publish(store, seed=2)
    assert states(store) == {1: "previous", 2: "current"}


def test_a_list_that_waited_too_long_is_signed_anew(store: MapStore, clock: Clock) -> None:
    """The first person's signature is of a list that is over when the second comes: robots would refuse it."""
    people, (ada, bob) = [KeyFolder(store.folder / "keys").signer("root")], [new_key(), new_key()]
    ceremonies.admit(store, "lab", [ada.public_key, bob.public_key], people, threshold=2, previous=1)
    (store.folder / "keys" / "site-lab.pem").unlink()
    publish(store, seed=2)
    assert ceremonies.sign_site(store, "lab", ada) == 1
    clock.now_ns += 15 * 24 * HOUR_NS
    assert ceremonies.sign_site(store, "lab", bob) == 1, "it begins anew"
    assert ceremonies.sign_site(store, "lab", ada) == 0
    now = datetime.fromtimestamp(clock() / 1e9, UTC)
    assert SignedLists(store.folder).served("lab").expires > now
    # A list that was put back from a copy: its number was used meanwhile.
    repository = ListRepository(SignedLists(store.folder), now)
    publish(store, seed=3)
    stale = repository.sign_site("lab", admitted_versions(store.releases("lab"), 1), [ada])
    stale.signed.version -= 1
    repository.lists.staged_path("lab").write_bytes(stale.to_bytes())
    assert [ceremonies.sign_site(store, "lab", key) for key in (ada, bob)] == [1, 0]
    assert states(store) == {2: "previous", 3: "current"}


def test_an_expired_list_is_not_accepted(store: MapStore, clock: Clock) -> None:
    repository = ListRepository(SignedLists(store.folder), datetime.fromtimestamp(clock() / 1e9, UTC))
    key = KeyFolder(store.folder / "keys").signer("site-lab")
    old = repository.sign_site("lab", admitted_versions(store.releases("lab"), 1), [])
    old.signed.expires -= timedelta(days=15)
    old.sign(key)
    with pytest.raises(StateError, match="expired"):
        repository.accept_site("lab", old)


def test_a_site_that_waits_for_other_keys_is_no_reason_to_sign_every_second(store: MapStore, clock: Clock) -> None:
    people, other = [KeyFolder(store.folder / "keys").signer("root")], new_key()
    ceremonies.admit(store, "lab", [other.public_key], people, threshold=1, previous=1)
    ceremonies.rotate_online(store, people)
    (store.folder / "keys" / "site-lab.pem").unlink()
    before = SignedLists(store.folder).read("timestamp").version
    for _ in range(3):
        clock.now_ns += 10**9
        update_lists(store)
    assert SignedLists(store.folder).read("timestamp").version == before
    assert any("lab" in words and "signature" in words for words in trust_status(store).faults)
    assert ceremonies.sign_site(store, "lab", other) == 0
    assert states(store) == {1: "current"}


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
    assert any("trust" in fault and "symbolic link" in fault for fault in verify_with_link(store, tmp_path))


def verify_with_link(store: MapStore, tmp_path: Path) -> list[str]:
    (store.folder / "trust" / "9.snapshot.json").symlink_to(tmp_path / "secret")
    return store.verify().faults


def test_a_key_does_not_close_a_folder_that_was_there(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    save_key(tmp_path / "ada.pem", new_key(), None)
    assert stat.S_IMODE(tmp_path.stat().st_mode) == 0o755
    save_key(tmp_path / "made" / "ada.pem", new_key(), None)
    assert stat.S_IMODE((tmp_path / "made").stat().st_mode) == 0o700


def test_metrics_say_how_long_the_lists_last(store: MapStore, clock: Clock) -> None:
    fleet = Fleet(store, clock_ns=clock)
    for robot, hours in (("r1", 0.5), ("r2", 31.0), ("r3", None)):
        health = RobotHealth(
            site="lab", robot=robot, stamp_ns=1, version=1, status="TRACKING", metrics={"map_word_hours": hours}
        )
        fleet.take_health("lab", robot, health)

    def figures() -> dict[str, float]:
        lines = Metrics(store, fleet).text().decode().splitlines()
        return {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in lines if line[0] != "#"}

    found = figures()
    assert found['fleetmap_site_map_word_hours_max{site="lab"}'] == 31.0
    days = {
        role: found[f'fleetmap_trust_days_left{{role="{role}"}}']
        for role in ("root", "targets", "timestamp", "site-lab")
    }
    assert days == {"root": 730.0, "targets": 365.0, "timestamp": 1.0, "site-lab": 14.0}
    assert found["fleetmap_trust_faults"] == 0
    clock.now_ns += 8 * 24 * HOUR_NS
    found = figures()
    assert found['fleetmap_trust_days_left{role="timestamp"}'] == -7.0
    assert found["fleetmap_trust_faults"] == 3  # timestamp, snapshot, and the site's list
    (store.folder / "trust" / "timestamp.json").write_text("{")
    assert figures()["fleetmap_trust_faults"] == 1


def test_a_stolen_server_can_publish_only_where_its_key_is_enough(store: MapStore) -> None:
    assert "who takes this machine can publish maps of lab" in " ".join(trust_status(store).risks)
    people, own = [KeyFolder(store.folder / "keys").signer("root")], KeyFolder(store.folder / "keys").signer("site-lab")
    both = [own.public_key, new_key().public_key]
    ceremonies.admit(store, "lab", both, people, threshold=2, previous=1)
    assert "can publish maps" not in " ".join(trust_status(store).risks)
