"""Two servers share a store; one after the other is killed while robots report and ask."""

from pathlib import Path

import httpx

from mapserver.store import MapStore
from mapserver.store.places import Places
from support.fleet.dashboard_scene import serving
from support.fleet.two_servers import run
from support.storage.map_samples import publish_samples
from support.storage.postgres_server import PostgresServer


def test_nothing_acknowledged_is_lost_and_nothing_is_counted_twice(postgres: PostgresServer, s3: str) -> None:
    found = run(postgres.database(), s3, robots=4, seconds=12.0, kill_every_s=4.0, every_s=0.2)
    assert found["wrong"] == []
    assert found["kills"] >= 2
    assert found["acknowledged"] and found["questions"]


def test_a_server_whose_database_is_away_says_so_and_goes_on(tmp_path: Path, postgres: PostgresServer) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        publish_samples(store, 1)
    MapStore.attach(tmp_path, Places(database=postgres.database()))

    def statuses(http: str) -> list[int]:
        pages = ("/readyz", "/v1/sites", "/metrics", "/dashboard/map")
        return [httpx.get(f"{http}{page}", timeout=60, follow_redirects=True).status_code for page in pages]

    with serving(tmp_path) as served:
        assert statuses(served.http) == [200] * 4
        postgres.stop()
        try:
            assert statuses(served.http) == [503] * 4
            assert httpx.get(f"{served.http}/healthz", timeout=60).status_code == 200
        finally:
            postgres.start()
        assert statuses(served.http) == [200] * 4
