"""A server's machine is lost with its disk. What is restored elsewhere hears its robots and knows its people; nobody touches a robot."""

import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import pyrage
import pytest

from fleetmap.messages import RobotHealth, encode_message
from locclient.daemon.server_sync import ServerSync
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.identity import GivenAddress, RobotIdentity
from locclient.maps.connection import connected
from mapserver.store import FailureFilter, MapStore
from support.fleet.reports import blindness
from support.fleet.tls_site import TlsSite
from support.storage.map_samples import publish_samples

SITE, WITHIN_S = "lab", 30.0
ROBOTS = [f"tote-{number}" for number in range(30)]


@contextmanager
def driving(site: TlsSite, name: str) -> Iterator[Outbox]:
    """An enrolled robot that reports each second; yields its outbox."""
    folder = site.folder / name
    RobotIdentity.enrol(folder, (site.folder / f"{name}.fleetmap").read_bytes())
    given = GivenAddress(
        site=None, robot=None, server=None, store=None, root=None, identity=str(folder), insecure=False
    )
    over, outbox = threading.Event(), Outbox(folder / "spool.sqlite3", max_bytes=10**6)
    with connected(given.resolve(), folder / "tiles") as connection:
        sync = ServerSync(connection.source, outbox, retry_s=1.0)

        def work() -> None:
            while not over.wait(1.0):
                stamp_ns = time.time_ns()
                sync.health.append(RobotHealth(site=SITE, robot=name, stamp_ns=stamp_ns, version=1, status="TRACKING"))
                sync.step()

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield outbox
        finally:
            over.set()
            thread.join()


@pytest.mark.timeout(300)
def test_thirty_robots_report_to_a_restored_server(tmp_path: Path) -> None:
    site, identity = TlsSite(tmp_path, SITE), pyrage.x25519.Identity.generate()
    (tmp_path / "backup.key").write_text(str(identity))
    with MapStore.open(site.store, create=True) as store:
        publish_samples(store, 1)
    site.run("mapserver", "trust", "init", "--here", "--host", "127.0.0.1", "--store", site.store)
    password = site.run("mapserver", "operators", "add", "ada", "--store", site.store).split()[-1]
    with ExitStack() as fleet:
        site.start()
        try:
            where = ("--site", SITE, "--store", site.store, "--endpoint", site.endpoint, "--out", tmp_path)
            site.run("mapserver", "robots", "enrol", *ROBOTS, *where)
            outboxes = {name: fleet.enter_context(driving(site, name)) for name in ROBOTS}
            key = ("--recipient", identity.to_public())
            site.run("mapserver", "backup", tmp_path / "backups", "--store", site.store, *key)
            for name, outbox in outboxes.items():
                outbox.put(QueuedReport(f"after-{name}", encode_message(blindness(f"after-{name}", name))))
            give_up_s = time.monotonic() + WITHIN_S
            while any(outbox.waiting() for outbox in outboxes.values()):
                assert time.monotonic() < give_up_s
                time.sleep(0.1)
        finally:
            site.stop(signal.SIGKILL)
        shutil.rmtree(site.store)
        where = ("--store", site.store, "--identity", tmp_path / "backup.key", "--reason", "the disk died")
        told = site.run("mapserver", "restore", tmp_path / "backups", *where)
        assert "1 versions of 1 sites, 30 enrolled robots, 1 people and programs" in told
        with site.serving(), httpx.Client(base_url=site.http) as ada, MapStore.open(site.store) as store:
            give_up_s = time.monotonic() + WITHIN_S
            entered = {"name": "ada", "password": password}
            assert ada.post("/sign-in", data=entered).headers["location"] == "/"
            heard, failures = set[str](), set[str]()
            while not heard == failures == set(ROBOTS) and time.monotonic() < give_up_s:
                time.sleep(0.2)
                robots = ada.get("/v1/robots").json()["robots"]
                heard = {robot["robot"] for robot in robots if robot["last_health"]}
                failures = {row.robot for row in store.fleet.failures(FailureFilter(site=SITE))}
            assert (len(heard), len(failures)) == (len(ROBOTS), len(ROBOTS))
