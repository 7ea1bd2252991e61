"""The robot's cache trusts neither its disk nor its size."""

import os
from pathlib import Path

import pytest

from fleetmap.errors import MapFormatError, StoreError
from fleetmap.mapformat import blob_path, sha256_hex
from locclient.tile_cache import StoreFolder, TileCache


def put(cache: TileCache, data: bytes) -> str:
    sha256 = sha256_hex(data)
    cache.put(sha256, data)
    return sha256


def test_bytes_survive_a_restart(tmp_path: Path) -> None:
    sha256 = put(TileCache(tmp_path), b"tile")
    again = TileCache(tmp_path)
    assert sha256 in again
    assert again.get(sha256) == b"tile"
    assert again.total_bytes == 4
    assert again.get("0" * 64) is None
    assert again.take_faults() == []


def test_damaged_bytes_are_removed_and_told(tmp_path: Path) -> None:
    cache = TileCache(tmp_path)
    sha256 = put(cache, b"tile")
    (tmp_path / blob_path(sha256)).write_bytes(b"tilt")
    assert cache.get(sha256) is None
    assert sha256 not in cache
    faults = cache.take_faults()
    assert len(faults) == 1
    assert sha256 in faults[0]
    assert cache.take_faults() == []
    assert not (tmp_path / blob_path(sha256)).exists()
    with pytest.raises(MapFormatError, match="damaged"):
        cache.put(sha256, b"tilt")


def test_least_recently_used_goes_first_also_after_a_restart(tmp_path: Path) -> None:
    cache = TileCache(tmp_path, max_bytes=300)
    a, b, c = (put(cache, bytes([value]) * 100) for value in range(3))
    assert cache.get(a) is not None
    d = put(cache, b"d" * 100)
    assert [sha256 in cache for sha256 in (a, b, c, d)] == [True, False, True, True]
    for age, sha256 in enumerate((c, a, d)):
        os.utime(tmp_path / blob_path(sha256), ns=(age, age))
    again = TileCache(tmp_path, max_bytes=300)
    put(again, b"e" * 150)
    assert [sha256 in again for sha256 in (a, c, d)] == [False, False, True]
    assert again.total_bytes == 250
    # What is larger than the cache is kept until something else comes, because it was asked for now.
    f = put(again, b"f" * 400)
    assert again.get(f) is not None
    assert again.total_bytes == 400


def test_leftovers_of_a_dead_process_are_removed(tmp_path: Path) -> None:
    put(TileCache(tmp_path), b"tile")
    leftover = next(tmp_path.glob("blobs/??")) / ".x.tmp"
    leftover.write_bytes(b"half")
    assert TileCache(tmp_path).total_bytes == 4
    assert not leftover.exists()


def test_a_full_disk_costs_the_cache_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = TileCache(tmp_path)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("locclient.tile_cache.os.fsync", full)
    sha256 = put(cache, b"tile")
    assert sha256 not in cache
    assert "No space left" in cache.take_faults()[0]
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_file_is_no_cache_and_no_store(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cache"):
        TileCache(tmp_path / "file")
    with pytest.raises(StoreError, match="no map store"):
        StoreFolder(tmp_path)


def test_a_damaged_current_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "sites" / "lab").mkdir(parents=True)
    folder = StoreFolder(tmp_path)
    assert folder.current_manifest("lab") is None
    (tmp_path / "sites" / "lab" / "current").write_bytes(b"\xff\xfe nonsense")
    with pytest.raises(StoreError, match="repair"):
        folder.current_manifest("lab")
    with pytest.raises(StoreError, match="incomplete"):
        folder.blob("0" * 64)
