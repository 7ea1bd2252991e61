"""Two servers share a store; one after the other is killed while robots report and ask."""

from support.fleet.two_servers import run
from support.storage.postgres_server import PostgresServer


def test_nothing_acknowledged_is_lost_and_nothing_is_counted_twice(postgres: PostgresServer, s3: str) -> None:
    found = run(postgres.database(), s3, robots=4, seconds=12.0, kill_every_s=4.0, every_s=0.2)
    assert found["wrong"] == []
    assert found["kills"] >= 2
    assert found["acknowledged"] and found["questions"]
