"""The store: versions and their states, what it refuses, what a crash leaves."""

import os
import sqlite3
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import GateRefusedError, MapFormatError, StoreError
from fleetmap.mapformat.names import current_path, sha256_hex
from fleetmap.mapformat.tile import decode_tile
from mapserver import releases
from mapserver.store import Actor, DraftContent, MapStore, chain_faults
from mapserver.store.places import read_places
from support.storage.map_samples import draft_details, publish_samples, random_tile, save_sample_draft
from support.storage.s3_server import Content


@pytest.fixture
def store(store_folder: Path):
    with MapStore.open(store_folder, create=True, clock_ns=lambda: 1_000) as opened:
        yield opened


def test_a_draft_becomes_current_and_the_next_one_replaces_it(store: MapStore, tmp_path: Path) -> None:
    assert save_sample_draft(store, seed=1) == 1
    assert store.current("lab") is None
    assert releases.publish(store, "lab") == 1
    first = store.current("lab")
    assert (first.state, first.parent, first.published_ns) == ("current", None, 1_000)
    assert save_sample_draft(store, seed=2) == 2
    assert store.current("lab").version == 1
    assert releases.publish(store, "lab") == 2
    kept = [(v.version, v.state, v.parent) for v in store.versions("lab")]
    assert kept == [(1, "published", None), (2, "current", 1)]
    manifest = store.manifest("lab", 2)
    assert [(tile.x, tile.y) for tile in manifest.tiles] == [(0, 0), (1, 0)]
    for entry in manifest.tiles:
        data = store.blob(entry.sha256)
        assert (sha256_hex(data), len(data)) == (entry.sha256, entry.bytes)
        assert len(decode_tile(data)) == entry.landmarks == 40
    info = store.version("lab", 2)
    assert info.map_bytes == info.manifest_bytes + sum(tile.bytes for tile in manifest.tiles)
    current = tmp_path / "store" / current_path("lab")
    is_folder = read_places(store.folder).content is None
    assert (current.read_text() if current.exists() else None) == (info.manifest_sha256 + "\n" if is_folder else None)
    assert store.archive("lab", 2) == b"archive"
    assert [event.kind for event in store.events("lab")] == ["saved", "published"] * 2
    assert [(s.site, s.current_version, s.versions) for s in store.sites()] == [("lab", 2, 2)]


def test_equal_tiles_are_kept_once(store: MapStore) -> None:
    save_sample_draft(store, seed=1)
    before = Content(store).count()
    save_sample_draft(store, seed=1)
    assert Content(store).count() == before + 1  # only the manifest is new


def test_drafts_that_no_robot_could_use_are_refused(store: MapStore) -> None:
    empty = random_tile(np.random.default_rng(0), landmarks=0)
    for tiles in ([], [empty]):
        store.save("lab", DraftContent(tiles=tiles, vocabulary=b"v", details=draft_details()))
        with pytest.raises(GateRefusedError, match="0 landmarks"):
            releases.publish(store, "lab")
    assert store.current("lab") is None
    assert {info.state for info in store.versions("lab")} == {"draft"}


def test_a_site_with_a_vocabulary_of_its_own_takes_another(store: MapStore) -> None:
    for words in (b"one", b"two"):
        save_sample_draft(store, vocabulary=words)
        releases.publish(store, "lab")
    assert store.verify().faults == []


def test_a_damaged_tile_is_not_published(store: MapStore) -> None:
    save_sample_draft(store)
    tile = store.manifest("lab", 1).tiles[0].sha256
    Content(store).write(tile, store.blob(tile)[:-1] + b"?")
    with pytest.raises(MapFormatError, match=tile):
        releases.publish(store, "lab")
    Content(store).remove(tile)
    with pytest.raises(StoreError, match="incomplete"):
        releases.publish(store, "lab")
    assert store.current("lab") is None
    # Saving the same bytes again heals them.
    save_sample_draft(store)
    assert releases.publish(store, "lab") == 2


def test_robots_reports_are_kept(store: MapStore) -> None:
    store.record_robot_report("lab", "r2", {"a": 1}, 3)
    store.record_robot_report("lab", "r1", {})
    store.record_robot_report("lab", "r2", {"a": 2})
    known = [(r.robot, r.version, r.last_report, r.last_seen_ns) for r in store.robots("lab")]
    assert known == [("r1", None, {}, 1_000), ("r2", 3, {"a": 2}, 1_000)]
    assert store.robots("other") == []


def test_two_open_stores_share_one_folder(store: MapStore, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store") as other:
        assert [save_sample_draft(s) for s in (store, other, store)] == [1, 2, 3]
        releases.publish(other, "lab", 2)
        assert store.current("lab").version == 2


def test_readers_see_whole_versions_while_another_process_publishes(store: MapStore, tmp_path: Path) -> None:
    publish_samples(store, 1)
    stop = threading.Event()

    def read() -> int:
        newest = 0
        while not stop.is_set():
            info = store.current("lab")
            assert info.version >= newest
            newest = info.version
            assert store.manifest("lab", newest).version == newest
            store.record_robot_report("lab", "r1", {"version": newest}, newest)
        return newest

    with ThreadPoolExecutor(3) as readers, MapStore.open(tmp_path / "store") as writer:
        reading = [readers.submit(read) for _ in range(3)]
        publish_samples(writer, 5)
        stop.set()
        assert all(future.result(timeout=30) >= 1 for future in reading)
    assert store.current("lab").version == 6


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "store.sqlite3").write_bytes(b"no database at all" * 100)
    with pytest.raises(StoreError, match="cannot be opened"):
        MapStore.open(tmp_path)
    (tmp_path / "store.sqlite3").unlink()
    connection = sqlite3.connect(tmp_path / "store.sqlite3")
    connection.execute("CREATE TABLE recipes (name)")
    connection.close()
    with pytest.raises(StoreError, match="not the database of a map store"):
        MapStore.open(tmp_path)


def test_a_kill_between_the_transaction_and_the_derived_file_is_repaired(tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        publish_samples(store, 1, first=1)
        save_sample_draft(store, seed=2)
        wanted = store.version("lab", 2).manifest_sha256
    program = (
        "import os, sys\nfrom pathlib import Path\nfrom mapserver import releases\nfrom mapserver.store import map_store\n"
        "map_store.MapStore._write_current_file = lambda *_: os._exit(9)\n"
        "releases.publish(map_store.MapStore.open(Path(sys.argv[1])), 'lab')\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], env=environment, check=False, timeout=60)
    assert done.returncode == 9
    current = tmp_path / current_path("lab")
    assert current.read_text().strip() != wanted
    with MapStore.open(tmp_path) as store:
        assert store.current("lab").version == 2
        assert current.read_text().strip() == wanted


def test_what_a_killed_writer_left_goes_after_a_day(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        publish_samples(store, 1)
        current = tmp_path / "store" / current_path("lab")
        old, new = (current.with_name(f".current.{mark * 16}.tmp") for mark in "ab")
        for path, age_s in ((old, 2 * 86_400), (new, 60)):
            path.write_bytes(b"half")
            os.utime(path, (time.time() - age_s,) * 2)
        publish_samples(store, 1)
    assert (old.exists(), new.exists()) == (False, True)


def test_text_from_outside_is_kept_alike(metadata_folder: Path) -> None:
    """Also NUL, which PostgreSQL does not store."""
    with MapStore.open(metadata_folder, create=True) as store:
        number = store.begin_job("lab", "build")
        store.update_job(number, "failed", "topic /a\0 cannot be read", {"topic": "/a\0"})
        store.audit("note", "a\0b", actor=Actor("ada", "\0"))
        assert store.job(number).report == {"topic": "/a\0"}
        assert [(line.detail, line.reason) for line in store.log()[::-1]] == [(r"a\x00b", r"\x00")]
        assert chain_faults(store.log()[::-1]) == []
