"""The log of a store, verifying it, collecting garbage, carrying versions to another store."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from fleetmap.errors import FleetmapError, MapFormatError, StateError, StoreError
from fleetmap.mapformat.names import current_path
from mapserver import releases
from mapserver.store import Actor, MapStore, Retention, chain_faults
from mapserver.store.places import read_places
from support.storage.clock import Clock
from support.storage.map_samples import publish_samples, save_sample_draft, states
from support.storage.s3_server import Content

ADA = Actor("ada", "a test")
DAY_NS = 86_400_000_000_000


@pytest.fixture
def store(store_folder: Path, clock: Clock):
    with MapStore.open(store_folder, create=True, clock_ns=clock) as opened:
        yield opened


def test_the_log_is_never_changed(store: MapStore) -> None:
    publish_samples(store, 1)
    for statement in ("DELETE FROM events", "UPDATE events SET actor = 'nobody'"):
        with pytest.raises(StoreError, match="never"), store._database.write() as connection:
            connection.execute(statement)
    assert len(store.log()[::-1]) == 2
    assert chain_faults(store.log()[::-1]) == []


def test_verify_names_what_is_wrong(store: MapStore, tmp_path: Path) -> None:
    publish_samples(store, 2)
    assert store.verify().faults == []
    root = tmp_path / "store"
    first, second = (tile.sha256 for tile in store.manifest("lab", 2).tiles)
    Content(store).write(first, b"other")
    Content(store).remove(second)
    is_folder = read_places(root).content is None
    if is_folder:
        (root / current_path("lab")).write_text("wrong")
        (root / "blobs" / first[:2] / ".leftover.tmp").write_bytes(b"x")
    with store._database.write() as connection:
        connection.execute("UPDATE versions SET landmarks = 7 WHERE version = 1")
        connection.execute("DELETE FROM version_blobs WHERE version = 1 AND kind = 'tile'")
    found = store.verify()
    text = "\n".join(found.faults)
    for words in (f"{first} is damaged", f"{second} is missing", "the database says", "reference different"):
        assert words in text
    assert ("does not name the current" in text) is is_folder
    assert (found.leftovers, found.orphans) == (int(is_folder), 2)


def test_garbage_goes_in_steps_and_nothing_that_is_used(store: MapStore, clock: Clock) -> None:
    publish_samples(store, 5)
    for seed in range(10, 14):
        save_sample_draft(store, seed=seed)
    store.record_robot_report("lab", "r1", {}, 2)
    keep = Retention(keep_versions=1, keep_drafts=1, keep_days=7)
    dry = store.collect_garbage(keep, dry_run=True)
    garbage = store.collect_garbage(keep, actor=ADA)
    assert (dry.retired, dry.removed, dry.files) == (garbage.retired, garbage.removed, garbage.files)
    assert (sorted(garbage.retired), garbage.removed) == ([("lab", 1), ("lab", 3)], [])
    assert states(store)[2] == "published"  # a robot runs it
    clock.now_ns += 8 * DAY_NS
    garbage = store.collect_garbage(keep)
    assert garbage.removed == [("lab", v) for v in (1, 3, 6, 7, 8)]
    assert states(store) == {2: "published", 4: "published", 5: "current", 9: "draft"}
    assert garbage.files > 0
    assert garbage.freed_bytes > 0
    found = store.verify()
    assert (found.faults, found.orphans) == ([], 0)
    assert save_sample_draft(store, seed=14) == 10  # numbers are never used again
    assert releases.roll_back(store, "lab") == 4
    clock.now_ns += 40 * DAY_NS
    assert ("lab", 2) not in store.collect_garbage(keep).removed  # what a rollback would go to
    assert releases.roll_back(store, "lab") == 2
    assert store.verify().faults == []


def test_leftovers_are_removed(store: MapStore) -> None:
    publish_samples(store, 1)
    is_folder = read_places(store.folder).content is None
    if is_folder:
        (next((store.folder / "blobs").iterdir()) / f".{'ab' * 8}.0011.tmp").write_bytes(b"half")
    store._blobs.put(b"nobody mentions this")
    foreign = ["blobs/README", "others/README"] if is_folder else ["blobs/README", "blobs/ab/README", "others/README"]
    for path in foreign:
        store._blobs._objects.put(path, [b"of somebody else"])
    found = store.verify()
    assert (found.faults, found.orphans, found.leftovers) == ([], 1, int(is_folder))
    garbage = store.collect_garbage()
    assert (garbage.files, garbage.freed_bytes) == ((2, 24) if is_folder else (1, 20))
    assert [store._blobs._objects.size(path) for path in foreign] == [16] * len(foreign)
    assert store.verify().orphans == 0


def test_garbage_waits_for_those_who_bring_bytes(store: MapStore, tmp_path: Path, monkeypatch) -> None:
    publish_samples(store, 1)
    monkeypatch.setattr("mapserver.store.files._LOCK_WITHIN_S", 0.1)
    with MapStore.open(tmp_path / "store") as other, other._database.locked("lock", shared=True):
        save_sample_draft(store, seed=7)
        with pytest.raises(StoreError, match="held by another process"):
            store.collect_garbage()
    # A process that was killed holds nothing.
    program = (
        "import os, sys\nfrom pathlib import Path\nfrom mapserver.store import MapStore\n"
        "with MapStore.open(Path(sys.argv[1]))._database.locked('lock'): os._exit(9)\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    folder = str(tmp_path / "store")
    done = subprocess.run([sys.executable, "-c", program, folder], env=environment, check=False, timeout=60)
    assert done.returncode == 9
    store.collect_garbage()


@pytest.mark.parametrize("archive", [True, False])
def test_a_version_travels_in_one_file(store: MapStore, tmp_path: Path, archive: bool) -> None:
    publish_samples(store, 2)
    file = tmp_path / "lab-2.fmex"
    assert store.export_version("lab", 2, file, archive=archive) == file.stat().st_size
    with MapStore.open(tmp_path / "other", create=True) as other:
        info = other.import_version(file, actor=ADA)
        assert (info.version, info.state, info.manifest_sha256) == (2, "draft", store.version("lab", 2).manifest_sha256)
        assert other.archive("lab", 2) == (b"archive" if archive else None)
        assert releases.publish(other, "lab") == 2
        assert other.import_version(file).state == "current"
        assert save_sample_draft(other, seed=5) == 3
        assert other.verify().faults == []
        save_sample_draft(store, seed=6)
        store.export_version("lab", 3, file)
        with pytest.raises(StateError, match="another version 3"):
            other.import_version(file)


def test_exports_that_are_not_whole_are_refused(store: MapStore, tmp_path: Path) -> None:
    publish_samples(store, 1)
    file = tmp_path / "lab.fmex"
    store.export_version("lab", 1, file)
    data = file.read_bytes()
    with MapStore.open(tmp_path / "other", create=True) as other:
        for position in range(0, len(data), 61):
            file.write_bytes(data[:position] + bytes([data[position] ^ 0x55]) + data[position + 1 :])
            with pytest.raises(MapFormatError):
                other.import_version(file)
        for damaged in (b"", data[:-1], data + b"x", data[: len(data) // 2]):
            file.write_bytes(damaged)
            with pytest.raises(MapFormatError):
                other.import_version(file)
        with pytest.raises(StoreError, match="cannot be read"):
            other.import_version(tmp_path / "nothing")
        assert other.sites() == []
        assert other.verify().orphans == 0


def test_a_damaged_version_is_not_exported(store: MapStore, tmp_path: Path) -> None:
    publish_samples(store, 1)
    tile = store.manifest("lab", 1).tiles[0].sha256
    Content(store).write(tile, store.blob(tile)[:-1] + b"?")
    with pytest.raises(FleetmapError, match="verify"):
        store.export_version("lab", 1, tmp_path / "lab.fmex")
    assert list(tmp_path.glob("*lab*")) == []


def test_days_until_the_disk_is_full_are_known_after_a_day(store: MapStore, clock: Clock, monkeypatch) -> None:
    """1 GB a day of 100 free ones, and a build that takes half of them for an hour."""
    free = [100e9]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=10**12, free=int(free[0])))
    for hour in range(49):
        found = store.disk_space()
        assert (found.grows_bytes_per_day is None) == (hour < 24)
        if found.days_left is not None and hour != 40:
            assert found.days_left == pytest.approx(free[0] / 1e9, rel=0.05)
        clock.now_ns += 3600 * 10**9
        free[0] += -1e9 / 24 - (50e9 if hour == 39 else -50e9 if hour == 40 else 0)
    free[0] = 100e9
    for _ in range(7 * 24 * 6):
        clock.now_ns += 600 * 10**9
        found = store.disk_space()
    assert (found.grows_bytes_per_day, found.days_left) == (0.0, None)
    clock.now_ns -= 3600 * 10**9
    assert store.disk_space().grows_bytes_per_day is None, "the clock was set back"
