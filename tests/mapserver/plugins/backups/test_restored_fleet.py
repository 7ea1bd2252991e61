"""A server's machine is lost with its disk. What is restored elsewhere hears its robots and knows its people; nobody touches a robot."""

import shutil
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path

import httpx
import pyrage
import pytest

from fleetmap.errors import LinkError
from fleetmap.messages import RobotHealth, encode_message
from locclient.daemon.server_sync import ServerSync
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.identity import MapAddress, RobotIdentity
from locclient.maps.map_client import connected
from mapserver.store import FailureFilter, MapStore
from support.fleet.reports import blindness
from support.fleet.tls_site import TlsSite
from support.storage.map_samples import publish_samples
from support.waiting import eventually

SITE, WITHIN_S, LEVEL_M = "lab", 60.0, 0.125
ROBOTS = [f"tote-{number}" for number in range(30)]


def drive(site: TlsSite, name: str, outbox: Outbox, over: threading.Event) -> None:
    """Enrols a robot, which then reports each second."""
    folder, bundle = site.folder / name, (site.folder / f"{name}.fleetmap").read_bytes()
    while (identity := RobotIdentity.load(folder, may_be_begun=True)) is None and not over.wait(0.5):
        with suppress(LinkError):  # while the server takes up others, it may listen to nobody
            RobotIdentity.enrol(folder, bundle)
    address = MapAddress(site=SITE, robot=name, server=identity.who.endpoint, identity=identity)
    with connected(address, identity.folder / "tiles") as connection:
        sync = ServerSync(connection, outbox, retry_s=1.0)
        while not over.wait(1.0):
            told = {"robot": name, "stamp_ns": time.time_ns(), "metrics": {"protection_m": LEVEL_M}}
            sync.health.append(RobotHealth(site=SITE, version=1, status="TRACKING", **told))  # type: ignore[arg-type]
            sync.step()


@pytest.mark.timeout(300)
def test_thirty_robots_report_to_a_restored_server(tmp_path: Path) -> None:
    site, identity, over = TlsSite(tmp_path, SITE), pyrage.x25519.Identity.generate(), threading.Event()
    (tmp_path / "backup.key").write_text(str(identity))
    with MapStore.open(site.store, create=True) as store:
        publish_samples(store, 1)
    where = ("--store", site.store)
    site.run("mapserver", "trust", "init", "--here", "--host", "127.0.0.1", *where)
    password = site.run("mapserver", "operators", "add", "ada", *where).split()[-1]
    spools = {name: Outbox(tmp_path / f"{name}.spool", max_bytes=10**6) for name in ROBOTS}
    site.start()
    try:
        at = ("--site", SITE, "--endpoint", site.endpoint, "--out", tmp_path)
        site.run("mapserver", "robots", "enrol", *ROBOTS, *where, *at)
        for name in ROBOTS:
            threading.Thread(target=drive, args=(site, name, spools[name], over), daemon=True).start()
        assert eventually(lambda: len(list(tmp_path.glob("*/robot.pem"))) == len(ROBOTS), WITHIN_S)
        site.run("mapserver", "backup", tmp_path / "backups", *where, "--recipient", identity.to_public())
        for name, spool in spools.items():
            spool.put(QueuedReport(f"after-{name}", encode_message(blindness(f"after-{name}", name))))
        assert eventually(lambda: not any(spool.waiting() for spool in spools.values()), WITHIN_S)
        site.stop(signal.SIGKILL)
        shutil.rmtree(site.store)
        key = ("--identity", tmp_path / "backup.key", "--reason", "the disk died")
        told = site.run("mapserver", "restore", tmp_path / "backups", *where, *key)
        assert "1 versions of 1 sites, 30 enrolled robots, 1 people and programs" in told
        with site.serving(), httpx.Client(base_url=site.http, timeout=20) as ada, MapStore.open(site.store) as store:
            assert ada.post("/sign-in", data={"name": "ada", "password": password}).headers["location"] == "/"

            def heard() -> list[str]:
                rows = ada.get("/v1/robots").json()["items"]
                failed = {row.robot for row in store.fleet.failures(FailureFilter(site=SITE))}
                rows = [row for row in rows if row["last_health"] and row["robot"] in failed]
                return sorted(r["robot"] for r in rows if r["last_health"]["metrics"]["protection_m"] == LEVEL_M)

            assert eventually(lambda: heard() == sorted(ROBOTS), WITHIN_S)
    finally:
        over.set()
        site.stop(signal.SIGKILL)
