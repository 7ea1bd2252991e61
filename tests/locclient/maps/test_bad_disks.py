"""A robot's disk that became read-only, or whose files belong to another account, keeps its map usable."""

import os
from pathlib import Path
from typing import Any

import msgspec
import pytest

import fleetmap.trust.tuf_client  # noqa: F401 - before an account is taken that cannot read it
from fleetmap.errors import FleetmapError, StoreError, UnreachableError
from fleetmap.mapformat.names import blob_path, sha256_hex
from fleetmap.trust import TrustedMap
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.delivery.report_delivery import write_failure
from locclient.identity import RobotIdentity
from locclient.maps.tile_cache import ActiveVersion, TileCache
from support.storage.bad_disks import KINDS, on_bad_disk, open_folder

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
        "faults": cache.take_faults(),
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
        assert (again.active("hall"), again.kept("hall"), again.get(ONE.blobs[0])) == (ONE, [TWO], TILE), (
            "nothing is lost"
        )


def test_a_read_that_fails_once_costs_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filled(tmp_path)
    cache = TileCache(tmp_path)
    for number in (5, 24):  # EIO, EMFILE

        def refuse(path: Path, number: int = number) -> bytes:
            raise OSError(number, os.strerror(number), str(path))

        with monkeypatch.context() as patch:
            patch.setattr(Path, "read_bytes", refuse)
            assert cache.get(ONE.blobs[0]) is None
        assert os.strerror(number) in cache.take_faults()[-1]
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
            trust = TrustedMap(folder / "trust", "hall", None, away)
            trust.refresh()
            outbox = Outbox(spool, max_bytes=10**6, is_needed=False)
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


def away(_: str) -> bytes | None:
    raise UnreachableError("nobody answers")


def test_a_spool_that_cannot_be_made_is_made_once_the_disk_lets_it(tmp_path: Path) -> None:
    place = tmp_path / "spool"
    place.write_bytes(b"")  # a file in the place of the folder
    with pytest.raises(StoreError, match="cannot be used"):
        Outbox(place / "spool.sqlite3", max_bytes=100)
    spool = Outbox(place / "spool.sqlite3", max_bytes=100, is_needed=False)
    assert "cannot be used" in spool.fault
    with pytest.raises(StoreError, match=r"\[run\] outbox"):
        spool.counts()
    place.unlink()
    spool.put(QueuedReport("a", b"a"))
    assert (spool.fault, spool.counts()["waiting"]) == ("", 1)
