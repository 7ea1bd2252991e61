"""Maps that come by other ways than a publication: an export file from elsewhere, and a database that somebody wrote into."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fleetmap.errors import FleetmapError, StateError, UntrustedError, UsageError
from mapserver import cli, releases
from mapserver.store import MapStore
from mapserver.trust import init_here, update_lists
from mapserver.trust.carried_lists import lists_path
from mapserver.trust.signing import check_base
from support.storage.map_samples import publish_samples, save_sample_draft


@pytest.fixture
def store(tmp_path: Path) -> Iterator[MapStore]:
    with MapStore.open(tmp_path / "store", create=True) as made:
        publish_samples(made, 2)
        init_here(made)
        yield made


def run(*words: object) -> None:
    result = CliRunner().invoke(cli.app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output


def exported(store: Path, file: Path, *words: object) -> Path:
    run("export", file, "--site", "lab", "--store", store, "--with-trust", *words)
    return file


def test_row_34_an_export_is_judged_by_the_senders_root(store: MapStore, tmp_path: Path) -> None:
    file, root = exported(store.folder, tmp_path / "lab.fmex"), store.folder / "trust" / "1.root.json"
    run("import", file, "--store", tmp_path / "there", "--root", root)
    with MapStore.open(tmp_path / "there") as there:
        assert [(info.version, info.state) for info in there.versions("lab")] == [(2, "draft")]


@pytest.mark.parametrize(
    "attack", ["foreign signer", "lists of another", "no lists", "damaged lists", "not admitted", "huge lists"]
)
def test_row_34_attacks(store: MapStore, tmp_path: Path, attack: str) -> None:
    file, root = exported(store.folder, tmp_path / "lab.fmex"), store.folder / "trust" / "1.root.json"
    kind: type[FleetmapError] = UntrustedError
    if attack in ("foreign signer", "lists of another"):
        with MapStore.open(tmp_path / "evil", create=True) as evil:
            for seed in (7, 8):
                save_sample_draft(evil, seed=seed)
                releases.publish(evil, "lab")
            init_here(evil)
        forged = exported(tmp_path / "evil", tmp_path / "forged.fmex")
        if attack == "lists of another":
            lists_path(forged).write_bytes(lists_path(file).read_bytes())
        file = forged
    elif attack == "no lists":
        lists_path(file).unlink()
        kind = UsageError
    elif attack == "damaged lists":
        lists_path(file).write_bytes(b"[" * 100_000)
    elif attack == "huge lists":
        lists_path(file).write_bytes(b" " * (9 << 20))
    else:
        releases.roll_back(store, "lab")  # version 2 may not be run any more
        exported(store.folder, file, "--version", 2)
    with pytest.raises(kind):
        run("import", file, "--store", tmp_path / "there", "--root", root)
    assert not (tmp_path / "there").exists()
    if attack != "no lists":
        run("import", file, "--store", tmp_path / "there")  # the control: without a root it becomes a draft for people


def test_row_33_an_archive_swapped_in_the_database(store: MapStore) -> None:
    """The next map would be built on it. A list named the right one, and none is signed that names the other."""
    current = store.current("lab")
    check_base(store, current)
    other = store._blobs.put(b"another survey")
    with store._transactions.write() as connection:
        connection.execute("UPDATE versions SET archive_sha256 = ? WHERE version = 2", (other,))
    assert store.archive("lab", 2) == b"another survey"  # the control: the store believes its table
    with pytest.raises(StateError, match="names other bytes for version 2"):
        check_base(store, store.current("lab"))
    with pytest.raises(StateError, match="names other bytes for version 2"):
        update_lists(store)


def test_an_archive_that_gc_removed_is_no_attack(store: MapStore) -> None:
    with store._transactions.write() as connection:
        connection.execute("UPDATE versions SET archive_sha256 = NULL WHERE version = 2")
    check_base(store, store.current("lab"))
    update_lists(store)


def test_row_34_another_archive_in_an_export(store: MapStore, tmp_path: Path) -> None:
    """Robots would not notice it, and the next map would be built on it."""
    with MapStore.open(tmp_path / "evil", create=True) as evil:
        publish_samples(evil, 2)
        other = evil._blobs.put(b"a survey of somebody else")
        with evil._transactions.write() as connection:
            connection.execute("UPDATE versions SET archive_sha256 = ?", (other,))
    file = tmp_path / "lab.fmex"
    run("export", file, "--site", "lab", "--store", tmp_path / "evil")
    lists_path(exported(store.folder, tmp_path / "honest.fmex")).rename(lists_path(file))
    with pytest.raises(UntrustedError, match="archive"):
        run("import", file, "--store", tmp_path / "there", "--root", store.folder / "trust" / "1.root.json")
    run("export", file, "--site", "lab", "--store", tmp_path / "evil", "--without-archive")
    run("import", file, "--store", tmp_path / "there", "--root", store.folder / "trust" / "1.root.json")  # the control
