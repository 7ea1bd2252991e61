"""A store's folder with links in it, on a full disk, read only, beside other users. docs/security.md, row 32."""

import os
import shutil
import stat
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

from fleetmap.errors import StoreError
from fleetmap.mapformat.names import blob_path, current_path
from mapserver.store import MapStore, Retention
from mapserver.store.files import keep_reserve, locked
from support.command_line import status
from support.storage.bad_disks import on_bad_disk, open_folder
from support.storage.map_samples import publish_samples, save_sample_draft

TESTS = Path(__file__).resolve().parents[2]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    with MapStore.open(tmp_path / "store", create=True) as store:
        publish_samples(store, 2)
    return tmp_path / "store"


# ------------------------------------------------------------------------------------------------------------------- links


def test_nothing_outside_of_the_store_is_removed(root: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "letter.txt").write_text("mine")
    (root / "blobs" / "zz").symlink_to(outside)
    (root / "blobs" / "00").mkdir(exist_ok=True)
    (root / "blobs" / "00" / "leftover").symlink_to(outside / "letter.txt")
    with MapStore.open(root) as store:
        found = [path for path in (root / "blobs").glob("*/*") if path.is_file()]
        assert outside / "letter.txt" in [path.resolve() for path in found], "the control: who follows links finds it"
        faults = store.verify().faults
        store.collect_garbage(Retention(0, 0, 0, 0))
    assert (outside / "letter.txt").read_text() == "mine"
    assert {Path(fault.split()[0]).name for fault in faults} == {"zz", "leftover"}


def test_nothing_outside_of_the_store_is_read(root: Path, tmp_path: Path) -> None:
    with MapStore.open(root) as store:
        tile = store.manifest("lab", 2).tiles[0].sha256
        path = root / blob_path(tile)
        moved = tmp_path / "moved"
        path.rename(moved)
        for kind in ("file", "folder", "pipe"):
            if kind == "file":
                path.symlink_to(moved)
            elif kind == "folder":
                path.unlink()
                path.parent.rename(tmp_path / "away")
                shutil.copy(moved, tmp_path / "away" / path.name)
                path.parent.symlink_to(tmp_path / "away")
            else:
                path.parent.unlink()
                path.parent.mkdir()
                os.mkfifo(path)
            if kind != "pipe":
                assert path.read_bytes() == moved.read_bytes(), "the control: the system follows it"
            with pytest.raises(StoreError, match=r"symbolic link|not a plain file"):
                store.export_version("lab", 2, tmp_path / "lab.fmex")
            with pytest.raises(StoreError):
                store.blob(tile)
            assert any(tile[:2] in fault for fault in store.verify().faults)
        assert not (tmp_path / "lab.fmex").exists()


def test_nothing_outside_of_the_store_is_written(root: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    current = root / current_path("lab")
    current.unlink()
    current.parent.rmdir()
    current.parent.symlink_to(outside)
    with pytest.raises(StoreError, match="symbolic link"):
        MapStore.open(root)
    current.parent.unlink()
    current.parent.mkdir()
    (outside / "victim").write_text("mine")
    current.symlink_to(outside / "victim")
    with MapStore.open(root) as store:
        assert store.verify().faults == []
        for folder in (root / "blobs").iterdir():
            folder.rename(outside / folder.name)
            folder.symlink_to(outside / folder.name)
        before = sorted(outside.rglob("*"))
        for seed in range(10, 13):
            try:
                save_sample_draft(store, seed=seed)
            except StoreError as error:
                assert "symbolic link" in str(error)
    assert [path for path in sorted(outside.rglob("*")) if path.parent.name != "blobs"] == before
    assert (outside / "victim").read_text() == "mine"
    (root / "lock").unlink()
    (root / "lock").symlink_to(outside / "lock")
    with pytest.raises(OSError, match="symbolic"), locked(root / "lock", shared=False):
        pass
    assert not (outside / "lock").exists()


# ------------------------------------------------------------------------------------------------------------- rights, row 32


def modes(folder: Path) -> set[str]:
    return {oct(stat.S_IMODE(path.stat().st_mode)) for path in (folder, *folder.rglob("*"))}


def test_a_store_is_for_its_owner_alone(tmp_path: Path, capsys) -> None:
    before = os.umask(0)
    try:
        plain = tmp_path / "plain"
        plain.write_text("the control")
        with MapStore.open(tmp_path / "store", create=True) as store:
            publish_samples(store, 2)
            store.record_robot_report("lab", "r1", {}, 2)
            store.export_version("lab", 2, tmp_path / "lab.fmex")
            assert modes(tmp_path / "store") == {"0o600", "0o700"}, "with the database's log beside it"
        for command in (("verify",), ("gc",), ("versions", "--site", "lab")):
            status("mapserver", *command, "--store", tmp_path / "store")
        status("mapserver", "import", tmp_path / "lab.fmex", "--store", tmp_path / "other")
    finally:
        os.umask(before)
    assert modes(tmp_path / "store") == modes(tmp_path / "other") == {"0o600", "0o700"}
    assert stat.S_IMODE(plain.stat().st_mode) & 0o044, "the control: others may read what is written without care"
    assert "other users" not in capsys.readouterr().out
    (tmp_path / "store" / "store.sqlite3").chmod(0o644)
    status("mapserver", "verify", "--store", tmp_path / "store")
    assert "other users of this machine can read the store" in capsys.readouterr().out


# --------------------------------------------------------------------------------------- read only, and a full disk


READING = (
    ("versions", "--site", "lab"),
    ("inspect", "--site", "lab", "--version", 1),
    ("diff", "--site", "lab", 1, 2),
    ("verify",),
    ("gc", "--dry-run"),
)


def read_all(root: Path) -> list[tuple[int, bool]]:
    """How the commands that read end, and whether they say something; and what may not be."""
    ended = []
    for command in READING:
        with redirect_stdout(StringIO()) as said:
            ended.append((status("mapserver", *command, "--store", root), bool(said.getvalue())))
    with pytest.raises(StoreError, match="cannot be opened"):
        MapStore.open(root)  # the control
    with MapStore.open(root, read_only=True) as store, pytest.raises(StoreError, match="cannot be written"):
        assert store.current("lab") is not None
        store.record_robot_report("lab", "r1", {}, 2)
    return ended


@pytest.mark.parametrize("kind", ["read-only", "another account"])
def test_commands_that_read_work_where_nothing_may_be_written(root: Path, kind: str) -> None:
    with open_folder() as folder:
        shutil.copytree(root, folder / "store")
        assert on_bad_disk(kind, folder, lambda: read_all(folder / "store")) == [(0, True)] * len(READING)
        assert sorted(path.name for path in (folder / "store").glob("store.sqlite3*")) == ["store.sqlite3"]


ON_A_FULL_DISK = """
import sys
sys.path[:0] = sys.argv[1].split(":")
from pathlib import Path
from support.storage.faulty_disk import FullDisk, install
from mapserver import cli
store, reserve = Path(sys.argv[2]), sys.argv[3] == "with reserve"
import mapserver.store.map_store, mapserver.commands.releases, mapserver.releases, mapserver.store.archive
if not reserve:
    (store / "reserve").unlink()
disk = FullDisk(str(store))
disk.measure()
install(disk)
def run(*words):
    sys.argv = ["mapserver", *words, "--store", str(store)]
    try:
        cli.main()
    except SystemExit as end:
        print(words[0], end.code or 0, flush=True)
if sys.argv[4] == "read":
    for command in (["versions", "--site", "lab"], ["inspect", "--site", "lab"], ["diff", "--site", "lab", "1", "2"], ["verify"]):
        run(*command)
run("gc", "--keep-versions", "0", "--keep-days", "0", "--keep-drafts", "0")
"""


@pytest.mark.parametrize(
    ("reserve", "is_killed"), [("with reserve", False), ("with reserve", True), ("without", False)]
)
def test_a_full_disk_can_be_read_and_cleared(root: Path, reserve: str, is_killed: bool) -> None:
    """A process of its own, because what it does to `os` and SQLite cannot be undone. A server that was killed leaves its log, which
    nobody reads without writing: the store is cleared all the same."""
    with MapStore.open(root) as store:
        save_sample_draft(store, seed=5)
        publish_samples(store, 1)
        log = (root / "store.sqlite3-wal").read_bytes()
        database = (root / "store.sqlite3").read_bytes()
    if is_killed:
        (root / "store.sqlite3").write_bytes(database)
        (root / "store.sqlite3-wal").write_bytes(log)
    is_read = reserve == "with reserve" and not is_killed
    files = len([path for path in (root / "blobs").rglob("*") if path.is_file()])
    given = ":".join([str(TESTS), *sys.path]), str(root), reserve, "read" if is_read else ""
    command = [sys.executable, "-c", ON_A_FULL_DISK, *given]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    lines = [line.split() for line in done.stdout.splitlines()]
    commands = {"versions", "inspect", "diff", "gc"}
    statuses = dict(words for words in lines if words[0] in commands and len(words) == 2)
    if is_read:
        assert [statuses[name] for name in ("versions", "inspect", "diff")] == ["0", "0", "0"], done.stderr
        assert "verify 0" in done.stdout
    left = len([path for path in (root / "blobs").rglob("*") if path.is_file()])
    if reserve == "with reserve":
        assert statuses["gc"] == "0", done.stderr
        assert left < files
        with MapStore.open(root) as store:
            assert store.verify().faults == []
    else:  # the control
        assert statuses["gc"] != "0"
        assert left == files
    keep_reserve(root)
    assert (root / "reserve").stat().st_size == 4 << 20
