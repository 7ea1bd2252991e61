"""The chained log: a line that was changed afterwards is found (row 38 of docs/security.md)."""

import json
import shutil
import sqlite3
from pathlib import Path

import pytest

from mapserver import releases
from mapserver.store import Actor, MapStore
from mapserver.trust import init_here
from support.storage.map_samples import save_sample_draft

TRIGGERS = ("events_are_kept", "events_stay_as_they_are")


def rewrite(folder: Path, *statements: str) -> None:
    """What somebody can do who owns the file."""
    with sqlite3.connect(folder / "store.sqlite3") as connection:
        for trigger in TRIGGERS:
            connection.execute(f"DROP TRIGGER {trigger}")
        for statement in statements:
            connection.execute(statement)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A signed store of some releases."""
    folder = tmp_path_factory.mktemp("audit") / "store"
    with MapStore.open(folder, create=True) as store:
        for seed in range(2):
            save_sample_draft(store, seed=seed)
            releases.publish(store, "lab", actor=Actor("ada", "monday"))
        init_here(store)
        store.audit("enrolled", "tug-7", actor=Actor("ada", "", "ada", "10.0.0.1"))
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """A copy to be changed."""
    return shutil.copytree(made, tmp_path / "store")


def test_an_honest_log_is_clean(run, folder: Path) -> None:
    assert run("audit", "--store", folder, "--verify") == "6 lines, clean\n"
    printed = run("audit", "--store", folder)
    assert len(printed.splitlines()) == 6
    assert "enrolled, 'tug-7', by 'ada' (signed in), from '10.0.0.1'" in printed
    assert len(json.loads(run("audit", "--store", folder, "--last", "2", "--json"))) == 2


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("UPDATE events SET actor = 'bob' WHERE id = 2", "line 2 was changed"),
        ("UPDATE events SET address = '10.0.0.2' WHERE id = 6", "line 6 was changed"),
        ("UPDATE events SET sha256 = '' WHERE id = 3", "line 3 was changed"),
        ("DELETE FROM events WHERE id = 3", "lines 3 to 3 are missing"),
        ("INSERT INTO events (id, stamp_ns, site, kind, detail) VALUES (7, 1, 'lab', 'x', 'y')", "line 7 was changed"),
    ],
)
def test_a_changed_line_is_found(run, folder: Path, statement: str, words: str) -> None:
    rewrite(folder, statement)
    assert words in run("audit", "--store", folder, "--verify", status=3)
