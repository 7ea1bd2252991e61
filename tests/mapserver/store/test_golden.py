"""Files of every released format are read by the code of today; newer ones are refused by naming what reads them."""

import errno
import importlib
import json
import os
import shutil
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fleetmap.errors import NewerFormatError, StoreError
from fleetmap.mapformat import MANIFEST_FORMAT, TILE_FORMAT, decode_manifest, decode_tile, encode_manifest, pack
from fleetmap.mapformat.version_file import EXPORT_FORMAT
from fleetmap.messages import decode_message, encode_message
from fleetmap.version_grid import known_grid
from mapserver import releases
from mapserver.store import Actor, FailureFilter, MapStore
from mapserver.store.archive import ARCHIVE_FORMAT, decode_archive
from mapserver.store.migrations import MIGRATIONS
from mapserver.surfels.surfel_map import known_surfels
from support.storage.map_samples import save_sample_draft

GOLDEN = Path(__file__).parents[2] / "golden"


@pytest.mark.parametrize(
    ("name", "newest"),
    [
        ("tile-{}.fmtl", TILE_FORMAT),
        ("tile-{}.json", TILE_FORMAT),
        ("manifest-{}.json", MANIFEST_FORMAT),
        ("archive-{}.fmar", ARCHIVE_FORMAT),
        ("version-{}.fmex", EXPORT_FORMAT),
        ("store-{}.sqlite3", len(MIGRATIONS)),
    ],
)
def test_every_format_has_its_file(name: str, newest: int) -> None:
    missing = [name.format(number) for number in range(1, newest + 1) if not (GOLDEN / name.format(number)).is_file()]
    assert missing == [], "python tests/golden/add.py adds the newest"


@pytest.mark.parametrize("file", sorted(GOLDEN.glob("tile-*.fmtl")), ids=lambda file: file.stem)
def test_tiles(file: Path) -> None:
    tile = decode_tile(file.read_bytes())
    wanted = json.loads(file.with_suffix(".json").read_text())
    assert [tile.tile_x, tile.tile_y] == wanted["cell"]
    assert tile.size_m == wanted["size_m"]
    assert tile.landmark_ids.tolist() == wanted["landmark_ids"]
    assert tile.points_map.tolist() == wanted["points_map"]
    assert [bytes(row).hex() for row in tile.descriptors] == wanted["descriptors"]
    assert tile.place_ids.tolist() == wanted["place_ids"]
    np.testing.assert_allclose(tile.map_from_cam, wanted["map_from_cam"], atol=1e-12)


@pytest.mark.parametrize(("name", "data"), json.loads((GOLDEN / "messages-1.json").read_text()).items())
def test_messages_of_older_robots_and_servers_are_read_and_what_is_written_has_all_their_fields(
    name: str, data: str
) -> None:
    module, _, kind = name.rpartition(".")
    message_type = getattr(importlib.import_module(module), kind)
    older = bytes.fromhex(data)
    written = encode_message(decode_message(older, message_type))
    assert_holds(msgspec.msgpack.decode(written), msgspec.msgpack.decode(older))


def assert_holds(written: object, older: object) -> None:
    """Every field of the older one is there with its value; others are beside them, which older programs pass over."""
    if isinstance(older, dict) and isinstance(written, dict):
        for key, value in older.items():
            assert_holds(written[key], value)
    else:
        assert written == older


@pytest.mark.parametrize("file", sorted(GOLDEN.glob("manifest-*.json")), ids=lambda file: file.stem)
def test_manifests(file: Path) -> None:
    data = file.read_bytes()
    manifest = decode_manifest(data)
    assert (manifest.site, len(manifest.tiles), manifest.landmarks) == ("lab", 2, 16)
    assert manifest.report == {"path_m": 12.5}
    if manifest.format_version == MANIFEST_FORMAT:
        assert encode_manifest(manifest) == data


@pytest.mark.parametrize("file", sorted(GOLDEN.glob("archive-*.fmar")), ids=lambda file: file.stem)
def test_archives(file: Path) -> None:
    survey = decode_archive(file.read_bytes())
    assert len(survey.landmark_ids) == 8
    assert survey.map_from_body.shape == (3, 4, 4)


@pytest.mark.parametrize("number", range(1, EXPORT_FORMAT + 1))
def test_exports(number: int, tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        info = store.import_version(GOLDEN / f"version-{number}.fmex", actor=Actor("ada"))
        assert list(known_grid(store.manifest("lab", 1), store.blob)) == ([(0, 0)] if number >= 2 else [])
        assert len(known_surfels(store.manifest("lab", 1), store.blob)) == (20 if number >= 3 else 0)
        assert (info.site, info.version, info.state, info.tiles) == ("lab", 1, "draft", 2)
        assert store.archive("lab", 1) == b"archive 1"
        assert releases.publish(store, "lab") == 1
        assert store.verify().faults == []


@pytest.mark.parametrize("number", range(1, len(MIGRATIONS) + 1))
def test_databases_of_every_format_open_whole(tmp_path: Path, number: int) -> None:
    shutil.copy(GOLDEN / f"store-{number}.sqlite3", tmp_path / "store.sqlite3")
    shutil.copytree(GOLDEN / "store-blobs", tmp_path / "blobs")
    with MapStore.open(tmp_path) as store:
        assert store.verify().faults == []
        assert [robot.robot for robot in store.robots("lab")] == ["r1"]
        states = [info.state for info in store.versions("lab")]
        assert states == (["published", "current", "draft"] if number == 1 else ["current", "retired", "draft"])
        if number == 1:
            assert releases.roll_back(store, "lab") == 1
        assert releases.publish(store, "lab") == 3
        assert releases.roll_back(store, "lab") == 1
        assert store.verify().faults == []
        if number >= 2:
            assert [job.state for job in store.jobs()] == ["done"]
        evidence = store.evidence("lab", 3)
        assert (evidence is not None) is (number >= 3)
        assert evidence is None or evidence.held_out.draft.localised_share == 0.975
        if number >= 4:
            (failure,) = store.fleet.failures(FailureFilter())
            picture = b"jpeg" if number < 7 else b"\xff\xd8jpeg\xff\xd9"  # what is no JPEG is refused since then
            assert (failure.failure_id, store.fleet.picture(failure.number, 0)) == ("f1", picture)
            assert store.fleet.counters("lab", "cause", key="dark")["lab", "dark"].failures == 1


def test_a_store_is_copied_before_it_is_migrated_and_never_by_who_only_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    older, number = GOLDEN / f"store-{len(MIGRATIONS) - 1}.sqlite3", len(MIGRATIONS) - 1
    path, copy = tmp_path / "store.sqlite3", tmp_path / f"store-format-{number}.sqlite3"
    shutil.copy(older, path)
    before = path.read_bytes()
    with MapStore.open(tmp_path, read_only=True) as store:
        assert [info.state for info in store.versions("lab")] == ["current", "retired", "draft"]
        with pytest.raises(StoreError, match="refuses to be written"):
            store.record_robot_report("lab", "r1", {}, 1)
    assert (path.read_bytes(), copy.exists()) == (before, False)

    def is_full(_: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("mapserver.store.database.sync_folder", is_full)
        with pytest.raises(StoreError, match="make space: the store is as it was"):
            MapStore.open(tmp_path)
    assert format_of(path) == number
    copy.unlink()
    MapStore.open(tmp_path).close()
    assert (format_of(path), format_of(copy)) == (number + 1, number)
    assert rows_of(copy) == rows_of(older)
    copied = copy.read_bytes()
    MapStore.open(tmp_path).close()
    assert copy.read_bytes() == copied, "once"


def format_of(path: Path) -> int:
    with closing(sqlite3.connect(path)) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])


def rows_of(path: Path) -> list[str]:
    with closing(sqlite3.connect(path)) as connection:
        return sorted(connection.iterdump())


def test_a_draft_of_an_older_store_is_known_by_the_job_that_its_log_names(tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        save_sample_draft(store, actor=Actor("nightly", "nightly job 17"))
        save_sample_draft(store, actor=Actor("ada", "nightly job 18 was lost"))
    connection = sqlite3.connect(tmp_path / "store.sqlite3")
    connection.execute("ALTER TABLE versions DROP COLUMN job")
    for name in ("judged_ms", "found_ms", "continued"):
        connection.execute(f"ALTER TABLE tallies DROP COLUMN {name}")
    for name in ("operator", "address", "sha256"):
        connection.execute(f"ALTER TABLE events DROP COLUMN {name}")
    connection.execute("ALTER TABLE failures DROP COLUMN area")
    for name in ("heard_ns", "flags", "frame_ms", "exposure", "sharpness"):
        connection.execute(f"ALTER TABLE traces DROP COLUMN {name}")
    for name in ("tokens", "sessions", "operators", "site_files", "grid_blobs", "surfel_blobs", "failure_replays"):
        connection.execute(f"DROP TABLE {name}")
    connection.execute("PRAGMA user_version = 4")
    connection.close()
    with MapStore.open(tmp_path) as store:
        assert [info.job for info in store.versions("lab")] == [17, None]


def test_newer_formats_are_refused_by_number(tmp_path: Path) -> None:
    with pytest.raises(NewerFormatError, match=f"format {TILE_FORMAT + 1}.*up to {TILE_FORMAT}"):
        decode_tile(pack(b"FMTL", TILE_FORMAT + 1, b""))
    with pytest.raises(NewerFormatError, match=f"format {ARCHIVE_FORMAT + 1}.*up to {ARCHIVE_FORMAT}"):
        decode_archive(pack(b"FMAR", ARCHIVE_FORMAT + 1, b""))
    with pytest.raises(NewerFormatError, match=f"format {MANIFEST_FORMAT + 1}.*up to {MANIFEST_FORMAT}"):
        decode_manifest(b'{"format_version": %d}' % (MANIFEST_FORMAT + 1))
    export = bytearray((GOLDEN / "version-1.fmex").read_bytes())
    struct.pack_into("<H", export, 4, EXPORT_FORMAT + 1)
    (tmp_path / "newer.fmex").write_bytes(export)
    with MapStore.open(tmp_path / "store", create=True) as store:
        with pytest.raises(NewerFormatError, match=f"format {EXPORT_FORMAT + 1}.*up to {EXPORT_FORMAT}"):
            store.import_version(tmp_path / "newer.fmex")
        assert store.sites() == []
    connection = sqlite3.connect(tmp_path / "store" / "store.sqlite3")
    connection.execute(f"PRAGMA user_version = {len(MIGRATIONS) + 1}")
    connection.close()
    with pytest.raises(NewerFormatError, match=f"format {len(MIGRATIONS) + 1}.*up to {len(MIGRATIONS)}"):
        MapStore.open(tmp_path / "store")
