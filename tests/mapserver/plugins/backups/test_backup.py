"""Backups in a folder and in S3: only what is new is copied, what comes back is whole, and what is damaged is named."""

import io
import os
import sqlite3
import tarfile
import time
from pathlib import Path

import msgspec
import pyrage
import pytest

from fleetmap.encoding import to_json
from fleetmap.errors import FleetmapError, MapFormatError, StoreError, UsageError
from fleetmap.mapformat.names import blob_path, sha256_hex
from fleetmap.messages import WantedVersion
from fleetmap.trust.trusted_map import TrustedMap
from mapserver.plugins.backups.backup import back_up, recipient_of
from mapserver.plugins.backups.restore import identities_of, restore, verify
from mapserver.plugins.backups.snapshots import BackupTarget
from mapserver.store import Actor, MapStore, Retention
from mapserver.trust import KeyFolder, SignedLists, init_here
from mapserver.trust.signing import rotate_online
from support.storage.clock import Clock
from support.storage.map_samples import publish_samples, save_sample_draft

ADA = Actor("ada", "a drill")
DAY_NS = 86_400_000_000_000


@pytest.fixture
def store(store: MapStore) -> MapStore:
    publish_samples(store, 2)
    return store


@pytest.fixture
def target(tmp_path: Path) -> BackupTarget:
    return BackupTarget(str(tmp_path / "backups"), create=True)


@pytest.fixture(params=["folder", "s3"])
def where(request, tmp_path: Path) -> str:
    return str(tmp_path / "backups") if request.param == "folder" else f"{request.getfixturevalue('s3')}-backups"


def content(store: MapStore) -> list[tuple[object, ...]]:
    return [(v.version, v.state, v.manifest_sha256) for v in store.versions("lab")]


def test_what_is_restored_is_the_store(store: MapStore, where: str, tmp_path: Path, clock: Clock) -> None:
    target = BackupTarget(where, create=True)
    first = back_up(store, target)
    assert (first.uploaded, first.missing, first.has_keys) == (len(target.blobs.sizes()), (), False)
    save_sample_draft(store, seed=7)
    clock.now_ns += DAY_NS
    second = back_up(store, target)
    assert 0 < second.uploaded_bytes < first.uploaded_bytes
    assert verify(target).faults == []
    report = restore(target, tmp_path / "new", ADA)
    assert (report.snapshot, report.versions) == (second.snapshot, 3)
    with MapStore.open(tmp_path / "new", clock_ns=clock) as restored:
        assert restored.verify().faults == []
        assert content(restored) == content(store)
        assert restored.restored_ns() > 0
        assert restored.log(limit=1)[0].reason == ADA.reason
        assert save_sample_draft(restored, seed=8) > 1000, "the lost store may have given the next numbers"
    restore(target, tmp_path / "older", ADA, name=first.snapshot)
    with MapStore.open(tmp_path / "older", clock_ns=clock) as older:
        assert content(older) == content(store)[:2]


def test_old_snapshots_go_with_what_they_alone_name(store: MapStore, clock: Clock, target: BackupTarget) -> None:
    names = []
    for seed in range(4):
        clock.now_ns += 3 * DAY_NS
        save_sample_draft(store, seed=20 + seed)
        names.append(back_up(store, target, keep=9).snapshot)
    clock.now_ns += 40 * DAY_NS
    store.collect_garbage(Retention(keep_drafts=0, keep_days=0.0))
    last = back_up(store, target, keep=2)
    assert list(last.removed) == names[:3]
    assert target.snapshots() == [names[3], last.snapshot]
    assert verify(target).faults == []


def test_garbage_that_is_collected_meanwhile_is_no_fault(
    store: MapStore, tmp_path: Path, clock: Clock, target: BackupTarget
) -> None:
    save_sample_draft(store, seed=7)
    clock.now_ns += 40 * DAY_NS

    def collect(done: int, _: int) -> None:
        if done == 1:
            store.collect_garbage(Retention(keep_drafts=0, keep_days=0.0))

    assert back_up(store, target, progress=collect).missing == ()
    assert target.read()[1].versions == 2
    restore(target, tmp_path / "new", ADA)


def test_a_blob_that_the_store_lost_is_named_and_the_rest_is_kept(
    store: MapStore, tmp_path: Path, target: BackupTarget
) -> None:
    lost, damaged = (tile.sha256 for tile in store.manifest("lab", 2).tiles[:2])
    (store.folder / blob_path(lost)).unlink()
    (store.folder / blob_path(damaged)).write_bytes(b"other")
    report = back_up(store, target)
    assert set(report.missing) == {lost, damaged}
    assert len(verify(target).faults) == 2
    assert restore(target, tmp_path / "new", ADA).missing == report.missing


def test_a_backup_heals_what_the_store_loses_later(
    store: MapStore, tmp_path: Path, clock: Clock, target: BackupTarget
) -> None:
    back_up(store, target)
    (store.folder / blob_path(store.manifest("lab", 2).tiles[0].sha256)).unlink()
    clock.now_ns += DAY_NS
    assert back_up(store, target).missing == ()
    restore(target, tmp_path / "new", ADA)
    with MapStore.open(tmp_path / "new") as restored:
        assert restored.verify().faults == []


def test_a_damaged_backup_restores_nothing(store: MapStore, where: str, tmp_path: Path) -> None:
    target = BackupTarget(where, create=True)
    back_up(store, target)
    address = store.manifest("lab", 2).tiles[0].sha256
    target._objects.put(f"objects/{address[:2]}/{address}", [b"other"])
    with pytest.raises(MapFormatError, match=address):
        restore(target, tmp_path / "new", ADA)
    assert [address in fault for fault in verify(target).faults] == [True]
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["lock"]
    back_up(store, target)
    assert verify(target).faults == [], "what was found damaged is uploaded again"
    target._objects.put(f"objects/{address[:2]}/{address}", [b""])
    back_up(store, target)
    assert verify(target).faults == [], "what is shorter without being looked for"
    if "://" not in where:
        path = tmp_path / "backups/objects" / address[:2] / address
        os.truncate(path, 1 << 42)  # with holes: neither read nor written whole
        with pytest.raises(MapFormatError, match=address):
            restore(target, tmp_path / "new", ADA)
        assert [address in fault for fault in verify(target).faults] == [True]
        back_up(store, target)
    restore(target, tmp_path / "new", ADA)


def test_keys_come_back_with_the_right_identity_alone(store: MapStore, tmp_path: Path, target: BackupTarget) -> None:
    init_here(store)
    identity, other = pyrage.x25519.Identity.generate(), pyrage.x25519.Identity.generate()
    (tmp_path / "key").write_text(f"# made by age-keygen\n{identity}\n")
    (tmp_path / "other").write_text(f"{other}\n")
    assert back_up(store, target, recipient=recipient_of(str(identity.to_public()))).has_keys
    secret = (store.folder / "keys" / "online.pem").read_bytes()
    assert not any(secret in path.read_bytes() for path in (tmp_path / "backups").rglob("*") if path.is_file())
    with pytest.raises(UsageError, match="not the key"):
        restore(target, tmp_path / "new", ADA, identities=identities_of(tmp_path / "other"))
    without = restore(target, tmp_path / "without", ADA)
    assert (without.keys, without.lists) == ((), "old")
    restored = restore(target, tmp_path / "new", ADA, identities=identities_of(tmp_path / "key"))
    assert restored.lists == "new"
    assert secret in [path.read_bytes() for path in (tmp_path / "new" / "keys").glob("online.*.old")]
    assert (tmp_path / "new" / "keys" / "online.pem").stat().st_mode & 0o777 == 0o600
    lists, before = SignedLists(tmp_path / "new"), SignedLists(store.folder)
    assert lists.newest("site-lab") > before.newest("site-lab") + 1000


def test_a_hostile_target_writes_nowhere_else(store: MapStore, tmp_path: Path, target: BackupTarget) -> None:
    identity = pyrage.x25519.Identity.generate()
    name = back_up(store, target, recipient=identity.to_public()).snapshot
    found = target.read(name)[1]
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("../../outside.pem"))
    target.blobs.put(stolen := pyrage.encrypt(packed.getvalue(), [identity.to_public()]))
    hostile = [
        msgspec.structs.replace(found, files={**found.files, "../outside": found.files["store.sqlite3"]}),
        msgspec.structs.replace(found, blobs={"../outside": 1}),
        msgspec.structs.replace(found, blobs={"0" * 64: 1 << 60}),
        msgspec.structs.replace(found, blobs=dict.fromkeys(found.blobs, 1)),
        msgspec.structs.replace(found, keys=sha256_hex(stolen)),
        msgspec.structs.replace(found, files={**found.files, "keys/online.pem": found.files["store.sqlite3"]}),
        msgspec.structs.replace(found, format=3),
        msgspec.structs.replace(found, files={"store.sqlite3": found.files["store.sqlite3"][:1] * 300_000}),  # 1.2 TB
    ]
    for bad in [to_json(snapshot) for snapshot in hostile] + [b"{", b"[]", b"\xff"]:
        (tmp_path / "backups" / "snapshots" / f"{name}.json").write_bytes(bad)
        with pytest.raises(FleetmapError):
            restore(target, tmp_path / "new", ADA, identities=[identity])
        assert {path.name for path in (tmp_path / "new").iterdir()} <= {"lock"}
        assert {path.name for path in tmp_path.iterdir()} <= {"backups", "store", "new"}


def test_a_clock_that_was_ahead_hides_no_later_snapshot(
    store: MapStore, tmp_path: Path, clock: Clock, target: BackupTarget
) -> None:
    clock.now_ns += 400 * DAY_NS
    back_up(store, target, keep=1)
    clock.now_ns -= 400 * DAY_NS
    save_sample_draft(store, seed=7)
    assert [back_up(store, target, keep=1).snapshot] == target.snapshots()
    assert restore(target, tmp_path / "new", ADA).versions == 3


def test_a_target_that_fails_is_not_a_store_that_lost_something(
    store: MapStore, target: BackupTarget, monkeypatch
) -> None:
    back_up(store, target, keep=1)
    before = target.snapshots()
    save_sample_draft(store, seed=7)
    real = target._objects.put

    def put(path: str, chunks: object, **more: bool) -> None:
        if not isinstance(chunks, list):
            raise StoreError("No space left on device")
        real(path, chunks, **more)

    monkeypatch.setattr(target._objects, "put", put)
    with pytest.raises(StoreError, match="No space"):
        back_up(store, target, keep=1)
    assert target.snapshots() == before


def test_a_folder_with_something_in_it_stays_as_it_is(
    store: MapStore, tmp_path: Path, target: BackupTarget, monkeypatch
) -> None:
    back_up(store, target)
    disk = tmp_path / "disk"  # a new file system
    (disk / "lost+found").mkdir(parents=True)
    monkeypatch.chdir(disk)
    restore(target, Path(), ADA)
    with MapStore.open(disk) as restored:
        assert restored.verify().faults == []
    with pytest.raises(UsageError, match="holds"):
        restore(target, disk, ADA)


def test_what_counts_restorations_is_bounded(store: MapStore, tmp_path: Path, target: BackupTarget) -> None:
    back_up(store, target)
    restores = tmp_path / "backups" / "restores"
    restores.mkdir()
    (restores / str(10**18)).touch()
    restore(target, tmp_path / "new", ADA)
    (restores / "000001-root-1300").touch()
    with pytest.raises(StoreError, match="1300 roots"):
        target.known_root(100)
    (restores / "60000").touch()
    with pytest.raises(StoreError, match="60000 restorations"):
        restore(target, tmp_path / "newer", ADA)
    assert {path.name for path in (tmp_path / "newer").iterdir()} == {"lock"}


def test_keys_that_only_the_unit_can_read_come_back(store: MapStore, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "credentials").mkdir()
    for name in ("online", "root", "site-lab"):
        (tmp_path / "credentials" / f"fleetmap-{name}").write_text("a passphrase of the unit")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path / "credentials"))
    init_here(store)
    target, identity = BackupTarget(str(tmp_path / "backups"), create=True), pyrage.x25519.Identity.generate()
    back_up(store, target, recipient=identity.to_public())
    monkeypatch.delenv("CREDENTIALS_DIRECTORY")
    report = restore(target, tmp_path / "new", ADA, identities=[identity])
    assert report.lists == "old"
    assert "online.pem" in report.keys


@pytest.mark.parametrize("change", ["a site", "the online key", "both"])
def test_robots_accept_lists_older_than_a_site_or_a_key_that_they_know(
    store: MapStore, tmp_path: Path, clock: Clock, change: str
) -> None:
    clock.now_ns = time.time_ns()
    init_here(store)
    root = (store.folder / "trust" / "1.root.json").read_bytes()
    target, identity = BackupTarget(str(tmp_path / "backups"), create=True), pyrage.x25519.Identity.generate()
    back_up(store, target, recipient=identity.to_public())
    if change != "the online key":
        publish_samples(store, 1, first=3, site="other")
    if change != "a site":
        rotate_online(store, KeyFolder(store.folder / "keys").signer("root"))
    known = follow(tmp_path / "robot", root, store).read("timestamp").version
    restore(target, tmp_path / "new", ADA, identities=[identity])
    with MapStore.open(tmp_path / "new") as restored:
        assert follow(tmp_path / "robot", root, restored).read("timestamp").version > known


def follow(robot: Path, root: bytes, store: MapStore) -> SignedLists:
    """A robot that trusts this root takes the store's current version; the store's lists."""
    lists, current = SignedLists(store.folder), store.current("lab")
    trusted = TrustedMap(robot, "lab", root, lambda name: lists.file("lab", name) or None)
    trusted.refresh()
    trusted.admitted(WantedVersion(site="lab", version=current.version, manifest_sha256=current.manifest_sha256))
    return lists


def test_wrong_words_get_a_next_step(store: MapStore, tmp_path: Path, s3: str, monkeypatch) -> None:
    with pytest.raises(UsageError, match="holds no backups"):
        BackupTarget(str(tmp_path / "nothing"))
    target = BackupTarget(str(tmp_path / "backups"), create=True)
    with pytest.raises(UsageError, match="no snapshot"):
        restore(target, tmp_path / "new", ADA)
    with pytest.raises(UsageError, match="public key of age"):
        recipient_of("age1wrong")
    back_up(store, target)
    with pytest.raises(UsageError, match="holds"):
        restore(target, store.folder, ADA)
    with pytest.raises(UsageError, match="without --recipient"):
        restore(target, tmp_path / "new", ADA, identities=[pyrage.x25519.Identity.generate()])
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(StoreError, match="credentials"):
        BackupTarget(f"{s3}-backups").snapshots()
    with pytest.raises(StoreError, match="credentials"):
        BackupTarget("nonsense://nowhere/a")


def test_an_open_transaction_is_not_half_in_a_backup(store: MapStore, tmp_path: Path, target: BackupTarget) -> None:
    other = sqlite3.connect(store.folder / "store.sqlite3", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    other.execute("UPDATE versions SET landmarks = 1 WHERE version = 1")
    back_up(store, target)
    other.execute("ROLLBACK")
    other.close()
    restore(target, tmp_path / "new", ADA)
    with MapStore.open(tmp_path / "new") as restored:
        assert restored.verify().faults == []
