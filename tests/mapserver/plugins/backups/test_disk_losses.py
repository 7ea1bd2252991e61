"""A server loses its disk, again and again, between two backups: what robots were told is stored comes back, once, and its lists count."""

import random
import shutil
import time
from contextlib import ExitStack
from pathlib import Path

import pyrage
import pytest

from fleetmap.messages import encode_message
from fleetmap.trust.trusted_map import TrustedMap, ask_over
from locclient.daemon.server_sync import ServerSync
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.plugins.backups.backup import back_up
from mapserver.plugins.backups.restore import restore
from mapserver.plugins.backups.snapshots import BackupTarget
from mapserver.serving.bus_service import BusService
from mapserver.store import Actor, FailureFilter, MapStore
from mapserver.trust import init_here, update_lists
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.fleet.reports import blindness
from support.storage.clock import Clock
from support.storage.map_samples import publish_samples, save_sample_draft

SITE, HOUR_NS = "lab", 3_600_000_000_000


class Server:
    """A store in a folder that can be lost, served on the hub, and backed up."""

    def __init__(self, folder: Path, hub: MemoryHub, clock: Clock) -> None:
        self.folder, self.hub, self.clock = folder / "store", hub, clock
        self.target = BackupTarget(str(folder / "backups"), create=True)
        self.identity = pyrage.x25519.Identity.generate()

    def start(self) -> None:
        self.stack = ExitStack()
        self.store = self.stack.enter_context(MapStore.open(self.folder, create=True, clock_ns=self.clock))
        bus = self.stack.enter_context(MemoryBus(self.hub))
        fleet = Fleet(self.store, clock_ns=self.clock)
        self.stack.callback(BusService(self.store, fleet, bus, lambda *_: None).close)

    def back_up(self) -> None:
        back_up(self.store, self.target, recipient=self.identity.to_public(), keep=3)

    def lose_disk(self) -> None:
        self.stack.close()
        shutil.rmtree(self.folder)
        report = restore(self.target, self.folder, Actor("ada", "the disk died"), identities=[self.identity])
        assert report.lists == "new"
        self.start()


class Robot:
    """Reports failures, follows the signed lists, and knows which reports the server has acknowledged."""

    def __init__(self, server: Server, folder: Path, name: str) -> None:
        self.name, bus = name, MemoryBus(server.hub)
        root, clock = (server.folder / "trust" / "1.root.json").read_bytes(), server.clock
        self.client = MapClient(bus, TileCache(folder / name), SITE, name)
        trust = TrustedMap(folder / name / "trust", SITE, root, ask_over(bus, SITE, name), lambda: clock.now_ns / 1e9)
        self.client.trust = trust
        self.outbox = Outbox(folder / f"{name}.spool", max_bytes=10**6, wall_ns=clock)
        self.sync = ServerSync(self.client, self.outbox, retry_s=1.0, clock_s=lambda: clock.now_ns / 1e9, wall_ns=clock)
        self.failed: set[str] = set()

    def fail(self, clock: Clock) -> None:
        failure = f"{self.name}-{len(self.failed)}"
        self.failed.add(failure)
        report = blindness(failure, self.name, wall_ns=clock.now_ns)
        self.outbox.put(QueuedReport(failure, encode_message(report)))

    @property
    def acknowledged(self) -> set[str]:
        return self.failed - {report.id for report in self.outbox.waiting(1000)}


def test_nothing_acknowledged_is_lost(tmp_path: Path) -> None:
    lose_disks(tmp_path, 4, 5)


@pytest.mark.timeout(7200)
def test_nothing_acknowledged_is_lost_in_fifty_losses(tmp_path: Path) -> None:
    lose_disks(tmp_path, 30, 50)


def lose_disks(tmp_path: Path, robots: int, losses: int) -> None:
    """Robots report while their server loses its disk again and again, and is restored."""
    clock, rng = Clock(time.time_ns()), random.Random(7)
    server = Server(tmp_path, MemoryHub(), clock)
    server.start()
    publish_samples(server.store, 2)
    init_here(server.store)
    server.back_up()
    fleet = [Robot(server, tmp_path, f"tote-{number}") for number in range(robots)]
    lost = unknown = 0
    while lost < losses:
        clock.now_ns += HOUR_NS
        update_lists(server.store)
        for robot in rng.sample(fleet, robots // 2):
            robot.fail(clock)
            robot.sync.step()
        what = rng.random()
        if what < 0.2:
            server.back_up()
        elif what < 0.4:
            save_sample_draft(server.store, seed=rng.randrange(1000))
            releases.publish(server.store, SITE)
        elif what < 0.7:
            told = set[str]().union(*(robot.acknowledged for robot in fleet))
            server.lose_disk()
            there = {row.failure_id for row in server.store.fleet.failures(FailureFilter(site=SITE))}
            lost, unknown = lost + 1, unknown + len(told - there)
    for _ in range(25):
        clock.now_ns += 4 * HOUR_NS
        update_lists(server.store)
        for robot in fleet:
            robot.sync.step()
            wanted = robot.client.wanted()
            assert wanted.version == server.store.current(SITE).version
            robot.client.trust.admitted(wanted)
    assert unknown > losses, "the drill must lose reports, or it shows nothing"
    rows = server.store.fleet.failures(FailureFilter(site=SITE))
    assert len(rows) == len({row.failure_id for row in rows})
    assert {row.failure_id for row in rows} == set[str]().union(*(robot.failed for robot in fleet))
    assert server.store.verify().faults == []
