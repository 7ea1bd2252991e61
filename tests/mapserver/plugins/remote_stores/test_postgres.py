"""What PostgreSQL alone brings: a database that goes away and comes back, locks of several machines, servers that share a store."""

import sqlite3
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import httpx
import pytest
from pg8000.dbapi import InterfaceError

from fleetmap.access import Access, Holder
from fleetmap.errors import BusyError, NewerFormatError, StoreError, UsageError
from fleetmap.messages import RobotHealth
from mapserver.fleet.fleet import Fleet
from mapserver.plugins.remote_stores import postgres as postgres_module
from mapserver.plugins.remote_stores.postgres import PostgresDatabase, Session
from mapserver.serving.bus_access import BusGuard
from mapserver.store import MapStore, chain_faults
from mapserver.store.database import Database
from mapserver.store.places import Places, read_places, write_places
from mapserver.store.schema import FORMAT
from mapserver.trust import SignedLists, init_here
from mapserver.trust.authorities import Authorities
from mapserver.trust.enrolment import RobotRegister
from mapserver.trust.signing import update_lists
from support.fleet.dashboard_scene import serving
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.fleet.two_servers import run
from support.storage.map_samples import publish_samples, save_sample_draft
from support.storage.postgres_server import PostgresServer
from support.waiting import eventually


@pytest.fixture
def folders(tmp_path: Path, postgres: PostgresServer, s3: str) -> tuple[Path, Path]:
    """Folders of two machines that share a store."""
    here, there = tmp_path / "here", tmp_path / "there"
    with MapStore.open(here, create=True) as store:
        publish_samples(store, 1)
        init_here(store)
    MapStore.attach(here, Places(s3, postgres.database()))
    (there / "keys").mkdir(parents=True)
    for path in (here / "keys").iterdir():
        (there / "keys" / path.name).write_bytes(path.read_bytes())
    MapStore.attach(there, read_places(here))
    return here, there


def test_a_database_that_was_restarted_is_found_again(folders: tuple[Path, Path], postgres: PostgresServer) -> None:
    with MapStore.open(folders[0]) as store:
        postgres.stop()
        with pytest.raises(StoreError, match="check the database"):
            store.sites()
        with pytest.raises(StoreError, match="check the database"):
            store.record_robot_report("lab", "r1", {}, 1)
        postgres.start()
        assert save_sample_draft(store, seed=5) == 2
        assert [info.site for info in store.sites()] == ["lab"]
        assert chain_faults(store.log()[::-1]) == []


def test_who_lost_a_lock_writes_nothing_under_it(folders: tuple[Path, Path], postgres: PostgresServer) -> None:
    with MapStore.open(folders[0]) as store, MapStore.open(folders[1]) as other:
        with store.locked("nightly-lab.lock"):
            with pytest.raises(BusyError), other.locked("nightly-lab.lock", waits=False):
                pass
            with pytest.raises(BusyError), store.locked("nightly-lab.lock", waits=False):
                pass  # not even the same process
            postgres.stop()
            postgres.start()
            with pytest.raises(StoreError):
                save_sample_draft(store, seed=5)
            with other.locked("nightly-lab.lock", waits=False), pytest.raises(StoreError, match="with it the lock"):
                save_sample_draft(store, seed=5)
        assert save_sample_draft(store, seed=5) == 2, "afterwards it is as before"


def test_one_leads_until_it_is_gone(folders: tuple[Path, Path], postgres: PostgresServer) -> None:
    with MapStore.open(folders[1]) as other:
        with MapStore.open(folders[0]) as store:
            assert [each.leads() for each in (store, other, store, other)] == [True, False, True, False]
        assert eventually(other.leads, 30.0)  # the database ends a closed session by itself
        postgres.stop()
        postgres.start()
        assert other.leads(), "in a new session"


@pytest.mark.parametrize("end", ["COMMIT", "ROLLBACK", "COMMIT later", "COMMIT of another database"])
def test_a_commit_without_an_answer_counts_once(folders: tuple[Path, Path], monkeypatch, end: str) -> None:
    with MapStore.open(folders[0]) as store, ThreadPoolExecutor(1) as thread:
        real = PostgresDatabase.run
        asked = threading.Event()

        def finish(database: PostgresDatabase, ended: Session) -> None:
            if end == "COMMIT later":
                asked.wait(30)
                time.sleep(0.3)
            real(database, ended, end.partition(" ")[0])
            ended.end()

        def cut(self: PostgresDatabase, session: Session, sql: str, values: tuple[object, ...] = ()) -> object:
            if sql.startswith("SELECT pg_advisory_xact_lock"):
                asked.set()
            if sql.startswith("SELECT pg_xact_status") and end.endswith("database"):
                sql = "SELECT pg_xact_status('99999999'::xid8)"
            if sql != "COMMIT":
                return real(self, session, sql, values)
            done = thread.submit(finish, self, session)
            if end != "COMMIT later":
                done.result()
            session.is_lost = True
            raise InterfaceError("network error")

        with monkeypatch.context() as patch:
            patch.setattr(PostgresDatabase, "run", cut)
            if end in ("COMMIT", "COMMIT later"):
                store.audit("note", "x")
            else:
                with pytest.raises(StoreError, match="network error" if end == "ROLLBACK" else "does not say whether"):
                    store.audit("note", "x")
        assert [line.kind for line in store.log()[::-1]].count("note") == (end != "ROLLBACK")
        assert chain_faults(store.log()[::-1]) == []


def test_a_write_does_not_wait_for_the_leader(folders: tuple[Path, Path], monkeypatch) -> None:
    """The network of the session that leads is slow."""
    with MapStore.open(folders[0]) as store, ThreadPoolExecutor(1) as thread:
        assert store.leads()
        real, asked, written = PostgresDatabase.run, threading.Event(), threading.Event()

        def slow(self: PostgresDatabase, session: Session, sql: str, *more: object) -> object:
            if sql == "SELECT 1":
                asked.set()
                assert written.wait(20), "a write waits"
            return real(self, session, sql, *more)

        monkeypatch.setattr(PostgresDatabase, "run", slow)
        led = thread.submit(store.leads)
        assert asked.wait(20)
        store.audit("note", "x")
        written.set()
        assert led.result()


def test_lists_and_enrolled_robots_are_those_of_all_servers(folders: tuple[Path, Path]) -> None:
    with MapStore.open(folders[0]) as store, MapStore.open(folders[1]) as other:
        assert SignedLists(folders[1]).served("lab").state("current").about.version == 1
        publish_samples(other, 1)
        update_lists(other)
        store.files.follow()
        for folder in folders:
            assert SignedLists(folder).served("lab").state("current").about.version == 2
        names = [sorted(path.name for path in (folder / "trust").glob("*.json")) for folder in folders]
        assert names[0] == names[1]
        with store.files.changing("keys") as root:
            (root / "keys" / "robots.json").write_text("[]\n")
        other.files.follow()
        assert (folders[1] / "keys" / "robots.json").read_text() == "[]\n"
        with pytest.raises(ZeroDivisionError), store.files.changing("trust") as root:
            (root / "trust" / "9.targets.json").write_text("half of a change")
            raise ZeroDivisionError
        other.files.follow()
        names += [sorted(path.name for path in (folder / "trust").glob("*.json")) for folder in folders]
        assert names == [names[0]] * 4


def test_robots_of_another_server_are_known(folders: tuple[Path, Path]) -> None:
    with MapStore.open(folders[0]) as store, MapStore.open(folders[1]) as other:
        here, there = Fleet(store), Fleet(other)
        here.take_health("lab", "r1", RobotHealth(site="lab", robot="r1", stamp_ns=1, status="TRACKING", version=1))
        here.flush()
        there.take_presence([])
        assert [(robot.robot, robot.version, robot.is_present) for robot in there.robots()] == [("r1", 1, True)]
        there.take_presence([])
        assert [robot.is_present for robot in there.robots()] == [False], "it reports to nobody any more"


def test_a_certificate_on_two_servers_is_told_by_both(folders: tuple[Path, Path]) -> None:
    """Not where a robot only changed from one to the other, nor of a server that was killed since."""
    with MapStore.open(folders[0]) as store, MapStore.open(folders[1]) as other:
        access, clock = Access([Holder("r1.0123", "lab", "r1")]), {"s": 0.0}
        stores, hubs = (store, other), (MemoryHub(), MemoryHub())
        for each in stores:
            each._database.now_ns = lambda: round(clock["s"] * 1e9)

        def guard(number: int) -> BusGuard:
            found = BusGuard(RobotRegister(stores[number]), MemoryBus(hubs[number]), lambda: clock["s"])
            found.access = access
            return found

        guards = [guard(0), guard(1)]

        def told(seconds: float, looking: list[BusGuard]) -> list[bool]:
            for _ in range(round(seconds / 5)):
                clock["s"] += 5.0
                for each in looking:
                    each.look()
            return [bool(each.copied) for each in looking]

        robot = MemoryBus(hubs[0], "r1.0123")
        assert told(30, guards) == [False, False]
        with MemoryBus(hubs[1], "r1.0123"), MemoryBus(hubs[1], "stranger"):
            assert told(15, guards) == [False, False], "the old connection may count still"
            assert told(15, guards) == [True, True]
            assert not any("stranger" in words for words in guards[0].look()), "its own server says so"
            there = Fleet(other)
            there.take_question("lab", "r1")
            there.take_copied(guards[1].copied)
            here = Fleet(store)
            here.take_health("lab", "r1", RobotHealth(site="lab", robot="r1", stamp_ns=1, status="TRACKING", version=1))
            here.flush()
            there.take_presence([])
            assert [status.is_copied for status in there.robots()] == [True], "whichever server heard it last"
            robot.close()
            assert told(5, guards) == [False, False]
        killed = MemoryBus(hubs[0], "r1.0123")
        told(5, guards)
        with MemoryBus(hubs[1], "r1.0123"):
            assert told(40, guards[1:]) == [False]
        killed.close()


def test_counts_go_to_no_other_key(folders: tuple[Path, Path]) -> None:
    """After a crash the database may lack the last commits of health, after a takeover by its replica more."""

    def report(fleet: Fleet, robot: str) -> None:
        for stamp_ns in range(3):
            health = RobotHealth(site="lab", robot=robot, stamp_ns=stamp_ns * 10**9, status="TRACKING", version=1)
            fleet.take_health("lab", robot, health)
        fleet.flush()

    with MapStore.open(folders[0]) as store, MapStore.open(folders[1]) as other:
        here, there = Fleet(store), Fleet(other)
        report(here, "r1")
        with other._database.write() as connection:
            connection.execute("TRUNCATE tally_keys, tallies, traces RESTART IDENTITY")
        report(there, "r2")
        report(here, "r1")
        report(here, "r1")
        keys = store._database.column("SELECT id FROM tally_keys ORDER BY id")
        assert keys == list(range(1, len(keys) + 1)), "known ones are not inserted again"
        counted = {key: counts.reports for (_, key), counts in store.fleet.counters("lab", "robot").items()}
        assert counted == {"r1": 6, "r2": 3}


def test_all_writers_get_their_turn(folders: tuple[Path, Path]) -> None:
    with MapStore.open(folders[0]) as store, MapStore.open(folders[1]) as other, ThreadPoolExecutor(4) as pool:
        for done in [pool.submit(each.audit, "note", str(n)) for n in range(40) for each in (store, other)]:
            done.result()
        lines = store.log()[::-1]
        assert [line.kind for line in lines].count("note") == 80
        assert chain_faults(lines) == []


def test_who_waited_in_vain_for_its_turn_leaves_no_transaction(folders: tuple[Path, Path], monkeypatch) -> None:
    monkeypatch.setattr(postgres_module, "_OPTIONS", f"{postgres_module._OPTIONS} -c lock_timeout=100ms")
    with MapStore.open(folders[0]) as store, MapStore.open(folders[1]) as other:
        with store._database.write(), pytest.raises(StoreError, match="lock timeout"):
            other.audit("note", "in vain")
        open_ones = "SELECT count(*) FROM pg_stat_activity WHERE state LIKE 'idle in transaction%'"
        assert store._database.value(open_ones) == 0
        other.audit("note", "now")
        assert [line.detail for line in store.log()[::-1]][-1:] == ["now"]


def test_a_writer_that_waited_sees_what_the_other_wrote(folders: tuple[Path, Path]) -> None:
    """Also where the database gives every transaction the state at its beginning."""
    with MapStore.open(folders[0]) as store, ThreadPoolExecutor(1) as pool:
        with store._database.write() as connection:
            connection.execute("ALTER ROLE fleet SET default_transaction_isolation = 'repeatable read'")
        try:
            with MapStore.open(folders[1]) as other:
                with store._database.write() as connection:
                    waits = pool.submit(other.audit, "note", "second")
                    while not other._database.query("SELECT 1 FROM pg_stat_activity WHERE wait_event = 'advisory'"):
                        time.sleep(0.01)
                    connection.log("", "note", "first")
                waits.result()
        finally:
            with store._database.write() as connection:
                connection.execute("ALTER ROLE fleet RESET default_transaction_isolation")
        assert [line.detail for line in store.log()[::-1]][-2:] == ["first", "second"]
        assert chain_faults(store.log()[::-1]) == []


def test_wrong_words_get_a_next_step(tmp_path: Path, postgres: PostgresServer) -> None:
    url = postgres.database()
    for wrong, words in (
        ("nonsense", "invalid"),
        ("postgresql://fleet:secret@host:port/x", "invalid"),
        (f"{url}?self=secret", "verify-full"),
        ("mysql://a/b", "PostgreSQL alone"),
        (f"{url}?sslmode=maybe", "verify-full"),
        (f"{url}?password=secret", "PGPASSWORD"),
        ("mysql://a:secret@b/c?password=secret", "PostgreSQL alone"),
    ):
        with pytest.raises(UsageError, match=words) as refused:
            PostgresDatabase(wrong, lambda: 1)
        assert "secret" not in str(refused.value)
    with pytest.raises(StoreError, match="mapserver attach"):
        PostgresDatabase(url, lambda: 1)
    with pytest.raises(UsageError, match="ENCODING 'UTF8'"):
        PostgresDatabase(postgres.database("-E", "SQL_ASCII", "-T", "template0", "--locale=C"), lambda: 1, create=True)
    with pytest.raises(StoreError, match="check the database") as error:
        PostgresDatabase("postgresql://fleet:secret@127.0.0.1:9/none", lambda: 1)
    assert "secret" not in str(error.value)
    write_places(tmp_path, Places(database=url))
    with MapStore.open(tmp_path, create=True) as store, store._database.write() as connection:
        connection.execute("UPDATE store_format SET number = ?", (FORMAT + 1,))
    with pytest.raises(NewerFormatError, match=f"format {FORMAT + 1}"):
        MapStore.open(tmp_path)


def test_a_served_store_is_not_moved(tmp_path: Path, s3: str) -> None:
    with (
        MapStore.open(tmp_path / "store", create=True) as store,
        store.served(),
        pytest.raises(BusyError, match="served"),
    ):
        MapStore.attach(tmp_path / "store", Places(s3))
    with MapStore.open(tmp_path / "store") as store:
        store.begin_job("lab", "build")
        with pytest.raises(BusyError, match="job 1"):
            MapStore.attach(tmp_path / "store", Places(s3))


def test_a_shared_store_moves_only_with_its_server_stopped_and_not_on(
    tmp_path: Path, postgres: PostgresServer, s3: str
) -> None:
    with MapStore.open(tmp_path, create=True):
        pass
    MapStore.attach(tmp_path, Places(database=postgres.database()))
    with MapStore.open(tmp_path) as store, store.served(), pytest.raises(BusyError, match="served"):
        MapStore.attach(tmp_path, Places(s3))
    MapStore.attach(tmp_path, Places(s3))
    for places in (Places(database=postgres.database()), Places(f"{s3}/other")):
        with pytest.raises(UsageError, match="restore a backup"):
            MapStore.attach(tmp_path, places)


def test_nobody_writes_what_is_not_copied(tmp_path: Path, postgres: PostgresServer, monkeypatch) -> None:
    with MapStore.open(tmp_path, create=True):
        pass
    copy, tried = PostgresDatabase.copy_from, list[str]()

    def copied(self: PostgresDatabase, source: Database) -> None:
        copy(self, source)
        with closing(sqlite3.connect(tmp_path / "store.sqlite3", timeout=0)) as other:
            with pytest.raises(sqlite3.OperationalError, match="locked"):
                other.execute("DELETE FROM jobs")
            tried.append("an operator's command")

    monkeypatch.setattr(PostgresDatabase, "copy_from", copied)
    MapStore.attach(tmp_path, Places(database=postgres.database()))
    assert tried


def test_a_connection_by_tls_is_checked_when_asked_for(tmp_path: Path, postgres: PostgresServer) -> None:
    """With a private authority, as most databases of a site have; the certificate is for 127.0.0.1."""
    for name in ("right", "wrong"):
        Authorities(tmp_path / name, datetime.now(UTC)).init(["127.0.0.1"], None, None)
    url, right = postgres.database(), f"sslrootcert={tmp_path}/right/servers-ca.crt"

    def ciphers(words: str, address: str = url) -> list[object]:
        with closing(PostgresDatabase(f"{address}?{words}", lambda: 1, create=True)) as opened:
            return [
                row["cipher"] for row in opened.query("SELECT cipher FROM pg_stat_ssl WHERE pid = pg_backend_pid()")
            ]

    with pytest.raises(StoreError, match="refuses SSL"):
        ciphers(f"sslmode=verify-full&{right}")
    postgres.stop()
    postgres.start(tmp_path / "right" / "server.pem")
    try:
        (checked,) = ciphers(f"sslmode=verify-full&{right}")
        assert checked
        assert ciphers("sslmode=prefer") == ciphers("") == [checked], "unchecked"
        assert ciphers("sslmode=disable") == [None]
        for words, address in (
            ("sslmode=verify-full", url),  # not the system's
            (f"sslmode=verify-full&{right.replace('right', 'wrong')}", url),
            (f"sslmode=verify-full&{right}", url.replace("127.0.0.1", "localhost")),
        ):
            with pytest.raises(StoreError, match=r"certificate is refused.*sslrootcert") as refused:
                ciphers(words, address)
            assert "127.0.0.1" in str(refused.value) or "localhost" in str(refused.value)
        for words in ("sslmode=verify-full&sslrootcert=/none", f"sslmode=verify-full&sslrootcert={__file__}"):
            with pytest.raises(UsageError, match="sslrootcert"):
                ciphers(words)
        with pytest.raises(UsageError, match="sslmode=verify-full"):
            ciphers(right)
        with closing(PostgresDatabase(f"{url}?sslmode=verify-full&{right}", lambda: 1)) as opened:
            postgres.stop()
            with pytest.raises(StoreError, match="check the database"):
                opened.query("SELECT 1")
            postgres.start(tmp_path / "right" / "server.pem")
            assert opened.query("SELECT 1 one") == [{"one": 1}]
    finally:
        postgres.stop()
        postgres.start()


def test_nothing_acknowledged_is_lost_and_nothing_is_counted_twice(postgres: PostgresServer, s3: str) -> None:
    """One server after the other is killed while robots report and ask."""
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
