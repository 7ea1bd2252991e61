"""The robot's cache trusts neither its disk nor its size: a read-only disk, or files of another account, keep its map usable."""

import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest

import fleetmap.trust.tuf_client  # noqa: F401 - before an account is taken that cannot read it
from fleetmap.errors import FleetmapError, MapFormatError, StoreError, UnreachableError
from fleetmap.mapformat.names import blob_path, sha256_hex
from fleetmap.trust.trusted_map import TrustedMap
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.delivery.report_delivery import write_failure
from locclient.identity import RobotIdentity
from locclient.maps.tile_cache import ActiveVersion, TileCache
from support.storage.bad_disks import KINDS, on_bad_disk, open_folder


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
    assert again.faults == 0


def test_damaged_bytes_are_removed_and_told(tmp_path: Path) -> None:
    cache = TileCache(tmp_path)
    sha256 = put(cache, b"tile")
    (tmp_path / blob_path(sha256)).write_bytes(b"tilt")
    assert cache.get(sha256) is None
    assert sha256 not in cache
    assert cache.faults == 1
    assert sha256 in cache.last_fault
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


def test_a_file_is_no_cache(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cache"):
        TileCache(tmp_path / "file")


def test_what_is_in_use_is_not_removed(tmp_path: Path) -> None:
    cache = TileCache(tmp_path, max_bytes=300)
    a, b = put(cache, b"a" * 100), put(cache, b"b" * 100)
    cache.activate("lab", 1, [a, b])
    c, d, e = (put(cache, letter * 100) for letter in (b"c", b"d", b"e"))
    assert [sha256 in cache for sha256 in (a, b, c, d, e)] == [True, True, False, False, True]
    # The next version on its way: nothing of both goes, even where that is more than the limit.
    later = [sha256_hex(letter * 100) for letter in (b"f", b"g")]
    cache.reserve("lab", [a, *later])
    put(cache, b"f" * 100)
    put(cache, b"g" * 100)
    assert [sha256 in cache for sha256 in (a, b, e, *later)] == [True, True, False, True, True]
    assert cache.total_bytes == 400
    cache.activate("lab", 2, [a, *later])
    assert b not in cache
    again = TileCache(tmp_path, max_bytes=100)
    assert again.active("lab") == ActiveVersion(2, (a, *later))
    put(again, b"h" * 50)
    assert all(sha256 in again for sha256 in (a, *later))


def test_a_version_with_a_missing_piece_is_not_activated(tmp_path: Path) -> None:
    cache = TileCache(tmp_path)
    a = put(cache, b"a")
    cache.activate("lab", 1, [a])
    with pytest.raises(StoreError, match=r"not whole: 1 of 2"):
        cache.activate("lab", 2, [a, "0" * 64])
    assert TileCache(tmp_path).active("lab").version == 1


@pytest.mark.parametrize(
    "text", [b"", b"{}", b'{"version":0,"blobs":["a"]}', b'{"version":1,"blobs":["../../x"]}', b"\xff"]
)
def test_a_damaged_record_is_told_and_forgotten(tmp_path: Path, text: bytes) -> None:
    cache = TileCache(tmp_path)
    cache.activate("lab", 1, [put(cache, b"a")])
    (tmp_path / "sites/lab/active").write_bytes(text)
    again = TileCache(tmp_path)
    assert again.active("lab") is None
    assert "damaged" in again.last_fault


def failing(real: Callable[..., object], left: Iterator[int], error: BaseException) -> Callable[..., object]:
    """Lets calls through until none is left; all others fail."""

    def call(*arguments: object, **options: object) -> object:
        if next(left) <= 0:
            raise error
        return real(*arguments, **options)

    return call


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), OSError(28, "No space left on device")], ids=["death", "full disk"]
)
def test_a_failure_at_any_moment_leaves_a_whole_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    """Every call to the file system in turn is the first that fails; a half-written name is never there."""
    for calls in range(60):
        folder = tmp_path / str(calls)
        cache = TileCache(folder)
        cache.activate("lab", 1, [put(cache, b"old")])
        left, is_finished = itertools.count(calls, -1), False
        with monkeypatch.context() as patch:
            for owner, name in ((os, "fsync"), (os, "open"), (Path, "open"), (Path, "replace"), (Path, "mkdir")):
                patch.setattr(owner, name, failing(getattr(owner, name), left, error))
            try:
                cache.activate("lab", 2, [put(cache, b"new"), put(cache, b"more")])
                is_finished = True
            except KeyboardInterrupt:
                pass
            except StoreError as refusal:
                assert cache.active("lab").version == 1
                assert "No space left" in f"{refusal} {cache.last_fault}"
                assert not list(folder.rglob("*.tmp"))
        again = TileCache(folder)
        record = again.active("lab")
        assert record.version == 2 if is_finished else record.version in {1, 2}
        assert all(again.get(sha256) for sha256 in record.blobs)
        assert again.faults == 0
        if is_finished:
            assert calls > 10
            return
    pytest.fail("never finished")


TILE, OTHER, NEW = (data * 100 for data in (b"tile", b"other", b"new"))
ONE, TWO = ActiveVersion(1, (sha256_hex(TILE),)), ActiveVersion(2, (sha256_hex(OTHER),))


def filled(folder: Path) -> None:
    cache = TileCache(folder)
    for data in (TILE, OTHER):
        cache.put(sha256_hex(data), data)
    cache.activate("hall", 1, ONE.blobs)
    cache.keep("hall", 2, TWO.blobs)
    cache.keep_file("hall", "alignment", b"here")
    (folder / blob_path(ONE.blobs[0])).with_name(".left.tmp").write_bytes(b"of a dead process")


def refusal(call: Any, *arguments: Any) -> str:
    try:
        call(*arguments)
    except StoreError as error:
        return str(error)
    return ""


def use_all(folder: Path) -> dict[str, Any]:
    """Every method of the cache, as a fresh process calls it, and what they gave."""
    cache = TileCache(folder)
    cache.put(sha256_hex(NEW), NEW)
    cache.reserve("hall", [sha256_hex(NEW)])
    cache.keep_file("hall", "alignment", b"there")
    cache.keep_file("hall", "alignment", None)
    return {
        "get": (cache.get(ONE.blobs[0]), cache.get(TWO.blobs[0]), cache.get(ONE.blobs[0])),
        "active": cache.active("hall"),
        "kept": cache.kept("hall"),
        "file": cache.kept_file("hall", "alignment"),
        "refused": [
            bool(refusal(call, "hall", version, *rest))
            for call, version, *rest in (
                (cache.activate, 2, TWO.blobs), (cache.keep, 3, ONE.blobs), (cache.release, 2),
            )
        ],
        "contains": sha256_hex(NEW) in cache,
        "room": cache.room_bytes() > 0,
        "faults": cache.faults,
    }  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_method_of_the_cache_on_a_disk_that_refuses(kind: str) -> None:
    with open_folder() as folder:
        filled(folder)
        found = on_bad_disk(kind, folder, lambda: use_all(folder))
        is_read = kind != "unreadable"
        assert found["get"] == ((TILE, OTHER, TILE) if is_read else (None, None, None))
        assert found["active"] == (ONE if is_read else None)
        assert found["kept"] == ([TWO] if is_read else [])
        assert found["file"] == (b"here" if is_read else None)
        assert found["refused"] == [True] * 3
        assert (found["contains"], found["room"], bool(found["faults"])) == (False, True, True)
        again = TileCache(folder)
        found = again.active("hall"), again.kept("hall"), again.get(ONE.blobs[0])
        assert found == (ONE, [TWO], TILE), "nothing is lost"


def test_a_read_that_fails_once_costs_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filled(tmp_path)
    cache = TileCache(tmp_path)
    for number in (5, 24):  # EIO, EMFILE
        with monkeypatch.context() as patch:
            patch.setattr(Path, "read_bytes", Mock(side_effect=OSError(number, os.strerror(number), "x")))
            assert cache.get(ONE.blobs[0]) is None
        assert os.strerror(number) in cache.last_fault
        assert cache.get(ONE.blobs[0]) == TILE


@pytest.mark.parametrize("kind", KINDS)
def test_lists_reports_and_identity_refuse_with_a_sentence_and_begin_again(kind: str) -> None:
    with open_folder() as folder:
        for name in ("trust", "spool", "failures", "identity"):
            (folder / name).mkdir()
        (folder / "trust" / "clock").write_text("5.0")
        spool = folder / "spool" / "spool.sqlite3"
        Outbox(spool, max_bytes=10**6).put(QueuedReport("a", b"a"))
        for name in ("robot.pem", "identity.json"):
            (folder / "identity" / name).write_text("{}")

        def use() -> list[str]:
            trust = TrustedMap(folder / "trust", "hall", None, Mock(side_effect=UnreachableError("nobody answers")))
            trust.refresh()
            outbox = Outbox(spool, max_bytes=10**6)
            identity = RobotIdentity(folder / "identity", None)  # type: ignore[arg-type]
            calls: list[tuple[Any, ...]] = [
                (outbox.put, QueuedReport("b", b"b")), (outbox.done, "a"), (identity._write, "robot.pem", b""),
                (write_failure, folder / "failures", Report()),
            ]  # fmt: skip
            for read in (outbox.waiting, outbox.counts):
                refusal(read)  # on some of these disks they can
            said = [refusal(*call) for call in calls]
            try:
                trust.admitted(ONE.wanted("hall"))
            except FleetmapError as error:
                said.append(str(error))
            return said

        said = on_bad_disk(kind, folder, use)
        assert len(said) == 5
        assert all(said), said
        assert Outbox(spool, max_bytes=10**6).waiting(9) == [QueuedReport("a", b"a")]


class Report(msgspec.Struct):
    """As much of a report as is read before the disk is asked."""

    stamp_ns: int = 1
    kind: str = "blind"
    cause: str = "dark"
    thumbnails: tuple[()] = ()


def test_a_spool_that_cannot_be_made_is_made_once_the_disk_lets_it(tmp_path: Path) -> None:
    place = tmp_path / "spool"
    place.write_bytes(b"")  # a file in the place of the folder
    spool = Outbox(place / "spool.sqlite3", max_bytes=100)
    with pytest.raises(StoreError, match=r"cannot be used .*\[run\] outbox"):
        spool.counts()
    place.unlink()
    spool.put(QueuedReport("a", b"a"))
    assert spool.counts()["waiting"] == 1
