"""The chained log: a line that was changed afterwards is found (row 38 of docs/security.md)."""

import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fleetmap.trust import TrustedMap
from mapserver import cli, releases
from mapserver.store import Actor, MapStore
from mapserver.store.access.chain import COLUMNS, line_sha256
from mapserver.trust import init_here, update_lists
from support.storage.map_samples import save_sample_draft

GOLDEN = Path(__file__).resolve().parents[2] / "golden"
TRIGGERS = ("events_are_kept", "events_stay_as_they_are")


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(cli.app, ["audit", *arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def rewrite(folder: Path, *statements: str) -> None:
    """What somebody can do who owns the file."""
    with sqlite3.connect(folder / "store.sqlite3") as connection:
        for trigger in TRIGGERS:
            connection.execute(f"DROP TRIGGER {trigger}")
        for statement in statements:
            connection.execute(statement)


def rewrite_whole(folder: Path) -> None:
    """A line changed, and all hashes behind it made anew."""
    rewrite(folder, "UPDATE events SET actor = 'bob' WHERE id = 2")
    with sqlite3.connect(folder / "store.sqlite3") as connection:
        before = ""
        for row in connection.execute(f"SELECT {COLUMNS} FROM events ORDER BY id").fetchall():
            before = line_sha256(before, row[:-1])
            connection.execute("UPDATE events SET sha256 = ? WHERE id = ?", (before, row[0]))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A signed store of some releases, whose timestamp a robot has kept."""
    with MapStore.open(tmp_path / "store", create=True) as store:
        for seed in range(2):
            save_sample_draft(store, seed=seed)
            releases.publish(store, "lab", actor=Actor("ada", "monday"))
        init_here(store)
        store.audit("enrolled", "tug-7", actor=Actor("ada", "", "ada", "10.0.0.1"))
        update_lists(store, all_anew=True)
    robot_asks(tmp_path / "store")
    return tmp_path / "store"


def robot_asks(store: Path) -> None:
    """What a robot does that asks for its map."""

    def ask(name: str) -> bytes | None:
        path = store / "trust" / name
        return path.read_bytes() if path.is_file() else None

    TrustedMap(store.parent / "robot", "lab", None, ask).refresh()


def test_an_honest_log_is_clean(folder: Path) -> None:
    witness = str(folder.parent / "robot" / "timestamp.json")
    assert run("--store", str(folder), "--verify", "--witness", witness) == (0, "6 lines, 2 witnesses, clean\n")
    status, printed = run("--store", str(folder))
    assert (status, len(printed.splitlines())) == (0, 6)
    assert "enrolled, 'tug-7', by 'ada' (signed in), from '10.0.0.1'" in printed
    assert len(json.loads(run("--store", str(folder), "--last", "2", "--json")[1])) == 2


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("UPDATE events SET actor = 'bob' WHERE id = 2", "line 2 was changed"),
        ("UPDATE events SET address = '10.0.0.2' WHERE id = 6", "line 6 was changed"),
        ("UPDATE events SET sha256 = '' WHERE id = 3", "line 3 was changed"),
        ("DELETE FROM events WHERE id = 3", "lines 3 to 3 are missing"),
        ("DELETE FROM events WHERE id = 6", "the log ends at line 5"),
        ("INSERT INTO events (id, stamp_ns, site, kind, detail) VALUES (7, 1, 'lab', 'x', 'y')", "line 7 was changed"),
    ],
)
def test_a_changed_line_is_found(folder: Path, statement: str, words: str) -> None:
    rewrite(folder, statement)
    status, printed = run("--store", str(folder), "--verify")
    assert status == 3
    assert words in printed


def test_a_log_written_anew_is_found_by_what_a_robot_kept(folder: Path) -> None:
    rewrite_whole(folder)
    with MapStore.open(folder) as store:
        update_lists(store, all_anew=True)  # the administrator has the online key too
    assert run("--store", str(folder), "--verify")[0] == 0, "the control: alone the store cannot know"
    status, printed = run(
        "--store", str(folder), "--verify", "--witness", str(folder.parent / "robot" / "timestamp.json")
    )
    assert status == 3
    assert "timestamp.json knows another line 6: the log was written anew" in printed


@pytest.mark.parametrize(
    "change", [lambda folder: None, lambda f: rewrite(f, "UPDATE events SET detail = 'x' WHERE id = 1")]
)
def test_the_lines_of_an_older_store_are_covered_by_the_next_one(
    tmp_path: Path, change: Callable[[Path], None]
) -> None:
    shutil.copy(GOLDEN / "store-6.sqlite3", tmp_path / "store.sqlite3")
    shutil.copytree(GOLDEN / "store-blobs", tmp_path / "blobs")
    with MapStore.open(tmp_path) as store:
        assert store.audit_mark() is None
        store.audit("opened", "by a newer version")
        assert store.audit_mark() is not None
    assert run("--store", str(tmp_path), "--verify")[0] == 0
    with MapStore.open(tmp_path) as store:
        before = len(store.audit_lines())
    change(tmp_path)
    changed = run("--store", str(tmp_path), "--verify")
    with sqlite3.connect(tmp_path / "store.sqlite3") as connection:
        is_changed = connection.execute("SELECT detail FROM events WHERE id = 1").fetchone()[0] == "x"
    assert changed[0] == (3 if is_changed else 0)
    assert not is_changed or f"line {before} was changed" in changed[1]


def test_refusals_of_the_command(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "nonsense.json").write_text("{}")
    for arguments, words in (
        (["--witness", "x"], "for --verify"),
        (["--verify", "--witness", "none"], "names no line"),
    ):
        with pytest.raises(Exception, match=words):
            run("--store", str(folder), *arguments)
    with pytest.raises(Exception, match="cannot be read as a timestamp"):
        run("--store", str(folder), "--verify", "--witness", str(tmp_path / "nonsense.json"))
