"""The commands that change and check a store, from the command line."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from fleetmap.mapformat.names import blob_path
from mapserver.store import MapStore
from support.storage.map_samples import publish_samples, save_sample_draft


def test_a_life_of_versions(run, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        for seed in range(3):
            save_sample_draft(store, seed=seed)
    in_store = ("--store", tmp_path / "store")
    where = ("--site", "lab", *in_store)
    first = run("publish", *where, "--version", 1)
    assert "version 1 is current (2 tiles, 80 landmarks" in first
    assert "held_out_frames" in first
    run("publish", *where, "--version", 2)
    assert "no version 5" in run("inspect", *where, "--version", 5, status=2)
    assert "--reason" in run("publish", *where, "--version", 3, "--force", status=2)
    rows = json.loads(run("versions", *where, "--json"))
    assert [(row["version"], row["state"]) for row in rows] == [(1, "published"), (2, "current"), (3, "draft")]
    assert "current" in run("versions", *where)
    assert "version 1 is current again" in run("rollback", *where, "--actor", "ada", "--reason", "lost robots")
    assert "version 2 is current" in run("promote", *where, 2)
    assert "error: version 3 of site lab is a draft" in run("promote", *where, 3, status=2)
    shown = json.loads(run("inspect", *where, "--version", 1, "--json"))
    assert [(event["kind"], event["actor"]) for event in shown["history"]][-1] == ("rolled_back", "ada")
    assert shown["manifest"]["report"] == {"path_m": 12.5}
    assert shown["bytes_per_m"] == pytest.approx(shown["map_bytes"] / 12.5)
    text = run("inspect", *where, "--version", 1)
    assert all(words in text for words in ("gate: accepted", "bytes per metre", "2 tiles of 16 m", "walk"))
    changed = json.loads(run("diff", *where, 1, 2, "--json"))
    assert (changed["tiles_changed"], changed["quality"]["path_m"]) == (2, {"before": 12.5, "after": 12.5})
    assert "fetches" in run("diff", *where, 1, 2)
    assert "version 2 is in" in run("export", *where, tmp_path / "lab.fmex")
    assert "(draft)" in run("import", tmp_path / "lab.fmex", "--store", tmp_path / "other")
    assert "0 files would be removed" in run("gc", *in_store, "--dry-run")
    assert json.loads(run("gc", *in_store, "--keep-drafts", 0, "--keep-days", 0, "--json"))["removed"] == [["lab", 3]]
    assert "no draft" in run("publish", *where, status=2)
    assert "clean" in run("verify", *in_store)


def test_verify_ends_with_a_status_of_its_own(run, tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        save_sample_draft(store)
        tile = store.manifest("lab", 1).tiles[0].sha256
    (tmp_path / blob_path(tile)).write_bytes(b"other")
    assert f"{tile} is damaged" in run("verify", "--store", tmp_path, status=3)
    assert len(json.loads(run("verify", "--store", tmp_path, "--json", status=3))["faults"]) == 1


def test_gc_leaves_a_store_that_it_refuses_as_it_is(run, tmp_path: Path) -> None:
    MapStore.open(tmp_path, create=True).close()
    with closing(sqlite3.connect(tmp_path / "store.sqlite3")) as connection:
        connection.execute("PRAGMA user_version = 99")
    before = (tmp_path / "store.sqlite3").read_bytes()
    assert "store format 99" in run("gc", "--store", tmp_path, status=3)
    assert (tmp_path / "store.sqlite3").read_bytes() == before
    assert (tmp_path / "reserve").is_file()


def test_the_gate_takes_its_limits_from_the_file(run, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        publish_samples(store, 1, first=1)
        save_sample_draft(store, seed=2)
    strict = tmp_path / "strict.toml"
    strict.write_text("[gate]\nmin_landmarks_share = 1.5\n")
    where = ("--site", "lab", "--store", tmp_path / "store")
    assert "number of landmarks is 1.00 of version 1's, below the limit of 1.5" in run(
        "publish", *where, "--config", strict, status=4
    )
    assert "refused" in run("inspect", *where, "--version", 2)
    assert "version 2 is current" in run("publish", *where)
