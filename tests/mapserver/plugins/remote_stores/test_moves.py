"""A store's parts move out of its folder and back, by the library and by the command."""

import shutil
from functools import partial
from pathlib import Path

import pytest

from fleetmap.errors import MapFormatError, StoreError
from mapserver.plugins.backups.backup import back_up
from mapserver.plugins.backups.restore import restore
from mapserver.plugins.backups.snapshots import BackupTarget
from mapserver.plugins.remote_stores import buckets
from mapserver.store import Actor, MapStore, chain_faults
from mapserver.store.blobs import Blobs
from mapserver.store.places import Places, open_objects, read_places
from support.storage.map_samples import publish_samples, save_sample_draft
from support.storage.postgres_server import PostgresServer
from support.storage.s3_server import Content

ADA = Actor("ada", "a test")


@pytest.fixture
def store(store_folder: Path):
    with MapStore.open(store_folder, create=True) as opened:
        yield opened


def test_a_store_moves_out_of_its_folder_and_back(tmp_path: Path, s3: str, postgres: PostgresServer) -> None:
    folder, database = tmp_path / "store", postgres.database()
    with MapStore.open(folder, create=True) as store:
        publish_samples(store, 2)
        store.record_robot_report("lab", "r1", {"note": "caf\u00e9"}, 2)
        tile, log = store.manifest("lab", 2).tiles[0].sha256, store.log()[::-1]
        data = store.blob(tile)
    with pytest.raises(StoreError, match="credentials"):
        MapStore.attach(folder, Places("s3://no-bucket-of-this-name"))
    assert read_places(folder) == Places()
    assert MapStore.attach(folder, Places(s3)) > 0
    assert MapStore.attach(folder, Places(f"{s3}-2", database)) > 0
    shutil.rmtree(folder / "blobs")
    with pytest.raises(StoreError, match="holds no map store"):
        MapStore.attach(tmp_path / "second", Places(s3, postgres.database()))
    MapStore.attach(tmp_path / "second", Places(f"{s3}-2", database))
    with MapStore.open(folder) as store, MapStore.open(tmp_path / "second") as second:
        assert (store.log()[::-1], store.robots("lab")[0].last_report) == (log, {"note": "caf\u00e9"})
        publish_samples(second, 1)
        job = second.begin_job("lab", "build")
        second.tell_progress(job, {"stage": "bundle"})
        assert [info.state for info in store.versions("lab")] == ["published", "published", "current"]
        assert store.verify().faults == chain_faults(store.log()[::-1]) == []
        back_up(store, target := BackupTarget(f"{s3}-backup", create=True))
    restore(target, tmp_path / "restored", ADA)
    with MapStore.open(tmp_path / "restored") as restored:
        assert restored.verify().faults == []
        assert chain_faults(restored.log()[::-1]) == []
        assert (restored.blob(tile), restored.jobs()[0].report) == (data, {"progress": {"stage": "bundle"}})
        restored.update_job(job, "failed", "the server is gone", {})
    with pytest.raises(StoreError, match="holds a store already"):
        MapStore.attach(tmp_path / "restored", Places(None, database))


def test_damaged_content_is_not_moved(store: MapStore, s3: str) -> None:
    publish_samples(store, 1)
    tile, folder, other = store.manifest("lab", 1).tiles[0].sha256, store.folder, f"{s3}-other"
    Content(store).write(tile, store.blob(tile)[:-1] + b"?")
    with pytest.raises(MapFormatError, match=tile):
        MapStore.attach(folder, Places(other))
    Content(store).remove(tile)
    with pytest.raises(StoreError, match=f"{tile} is missing"):
        MapStore.attach(folder, Places(other))
    assert tile not in Blobs(open_objects(other)).sizes()
    assert read_places(folder).content != other


def test_an_object_store_that_does_not_answer_is_no_damage(tmp_path: Path, s3: str, monkeypatch) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        publish_samples(store, 1)
    MapStore.attach(tmp_path / "store", Places(s3))
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setattr(buckets, "from_url", partial(buckets.from_url, retry_config={"max_retries": 0}))
    with MapStore.open(tmp_path / "store") as store:
        with pytest.raises(StoreError, match="credentials"):
            store.verify()
        with pytest.raises(StoreError, match="credentials"):
            back_up(store, BackupTarget(str(tmp_path / "backups"), create=True))
        with pytest.raises(StoreError, match="credentials"):
            save_sample_draft(store)
        assert store.current("lab").version == 1


def test_content_goes_where_attach_says(run, tmp_path: Path, s3: str) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        save_sample_draft(store)
    assert s3 in run("attach", "--store", tmp_path / "store", "--content", s3)
    (tmp_path / "store" / "blobs").rename(tmp_path / "not used any more")
    assert "clean" in run("verify", "--store", tmp_path / "store")
    (tmp_path / "store" / "places.json").write_text('{"contents": "s3://typing-error"}')
    assert "places.json" in run("verify", "--store", tmp_path / "store", status=2)


@pytest.mark.parametrize(
    "url", ["s3://key:secret@a/b", "s3://secret@a/b", "s3://a/b?aws_secret_access_key=secret", "s3://a#secret"]
)
def test_a_secret_in_a_url_is_not_shown(run, tmp_path: Path, url: str) -> None:
    MapStore.open(tmp_path / "store", create=True).close()
    for command in (("attach", "--content", url), ("backup", url)):
        told = run(*command, "--store", tmp_path / "store", status=2)
        assert "AWS_SECRET_ACCESS_KEY" in told
        assert "secret" not in told


def test_the_password_of_a_database_is_not_shown(run, tmp_path: Path, postgres: PostgresServer) -> None:
    url = postgres.database().replace("fleet@", "fleet:secret@")
    MapStore.open(tmp_path / "store", create=True).close()
    assert "secret" not in run("attach", "--store", tmp_path / "store", "--database", url)
