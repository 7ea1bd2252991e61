"""Attacks on a robot's map: by any participant of the bus, by a thief of the server, by replay. Each with its control."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pytest
from tuf.api.metadata import MetaFile, Snapshot, Timestamp

from fleetmap.errors import FleetmapError, LinkError, UntrustedError
from fleetmap.mapformat.building import ALIGNMENT, BuildingFrame, aligned_frame
from fleetmap.mapformat.names import blob_path
from fleetmap.messages import PART_BYTES, RobotAck, WantedVersion, decode_message, encode_message, part_of, robot_key
from fleetmap.trust.trusted_map import TrustedMap, ask_over
from locclient.daemon.server_sync import ServerSync
from locclient.delivery.outbox import Outbox
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from locclient.robot.version_trial import Change, VersionChange
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.floor_plan.alignment import PLAN, Alignment, encode_alignment
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore
from mapserver.trust import KeyFolder, SignedLists, init_here, update_lists
from mapserver.trust.repository import ListRepository, site_targets
from mapserver.trust.signing import admitted_versions
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.storage.map_samples import publish_samples, save_sample_draft

SITE, ROBOT = "lab", "r1"


@dataclass
class World:
    """An honest server, robots of its site, and whoever else takes part in the bus."""

    folder: Path
    hub: MemoryHub
    stack: ExitStack
    store: MapStore
    ahead_s: float = 0.0

    @property
    def trust_folder(self) -> Path:
        return self.store.folder / "trust"

    def bus(self) -> MemoryBus:
        return self.stack.enter_context(MemoryBus(self.hub))

    def client(self, name: str = "cache", *, trusting: bool = True) -> MapClient:
        """A robot with this cache, as after a restart."""
        bus = self.bus()
        client = MapClient(bus, TileCache(self.folder / name), SITE, ROBOT)
        if trusting:
            root, folder = (self.trust_folder / "1.root.json").read_bytes(), self.folder / name / "trust" / SITE
            ask = ask_over(bus, SITE, ROBOT)
            client.trust = TrustedMap(folder, SITE, root, ask, lambda: datetime.now(UTC).timestamp() + self.ahead_s)
        return client

    def sync(self, client: MapClient, clock_s: Callable[[], float] = time.monotonic) -> ServerSync:
        outbox = Outbox(self.folder / "outbox", max_bytes=10**6)
        return self.stack.enter_context(closing(ServerSync(client, outbox, retry_s=600.0, clock_s=clock_s)))

    def answer_first(self, what: str, answer: Callable[[str, bytes], bytes]) -> None:
        self.hub.queryables.insert(0, (robot_key(SITE, ROBOT, what), answer, None))

    def publish(self, seed: int) -> int:
        save_sample_draft(self.store, seed=seed)
        return releases.publish(self.store, SITE)

    def attacker(self, versions: int = 3) -> BusService:
        """Answers first, with maps and lists of its own; its version 3 is not the honest one."""
        store = self.stack.enter_context(MapStore.open(self.folder / "evil", create=True))
        publish_samples(store, versions, first=100)
        init_here(store)
        before = list(self.hub.queryables)
        made = BusService(store, Fleet(store), self.bus(), lambda *_: None)
        self.hub.queryables[:] = [entry for entry in self.hub.queryables if entry not in before] + before
        return made


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """Versions 1 (previous) and 2 (current), signed."""
    hub = MemoryHub()
    with ExitStack() as stack:
        store = stack.enter_context(MapStore.open(tmp_path / "store", create=True))
        publish_samples(store, 2)
        init_here(store)
        BusService(store, Fleet(store), stack.enter_context(MemoryBus(hub)), lambda *_: None)
        yield World(tmp_path, hub, stack, store)


def want(world: World, version: int, sha256: str | None = None) -> None:
    """Whoever answers `wanted` names this version, with the honest manifest's address unless another is given."""
    address = world.store.version(SITE, version).manifest_sha256 if sha256 is None else sha256
    answer = encode_message(WantedVersion(site=SITE, version=version, manifest_sha256=address))
    world.answer_first("wanted", lambda *_: answer)


def running(client: MapClient) -> int | None:
    active = client.active()
    return None if active is None else active.version


def test_row_1_a_forged_wanted_and_map(world: World) -> None:
    """Any participant answers first, with a whole map of its own."""
    assert world.client().ready().wanted.version == 2
    world.attacker()
    ready = world.client().ready()
    assert (ready.wanted.version, running(world.client())) == (2, 2)
    assert "version 2 stays active: signature: " in ready.note
    with pytest.raises(UntrustedError, match=r"^signature: "):
        fresh = world.client("fresh")
        fresh.fetch(fresh.wanted())
    victim = world.client("victim", trusting=False)
    assert victim.ready().wanted.version == 3  # the control: it runs the stranger's map
    assert running(victim) == 3


@pytest.mark.parametrize("attempt", ["forged", "old serial", "unlisted", "site list of the thief"])
def test_row_4_a_thief_of_the_online_key(world: World, attempt: str) -> None:
    """The online key and the folder, but not the site's key: nothing can be added to what it signed."""
    world.publish(seed=2)
    world.publish(seed=3)
    client = world.client()
    assert client.ready().wanted.version == 4
    repository, lists = ListRepository(world.store.folder, datetime.now(UTC)), SignedLists(world.store.folder)
    online = KeyFolder(world.store.folder / "keys").signer("online")
    number = lists.newest("site-lab")
    if attempt in ("forged", "site list of the thief"):
        want(world, 4, "f" * 64)
    if attempt == "unlisted":
        want(world, 1)
    if attempt == "site list of the thief":
        number += 1
        repository._sign("site-lab", site_targets(SITE, admitted_versions(world.store.releases(SITE)), number), online)
    if attempt == "old serial":
        want(world, 2)
        number -= 1
    meta = {"targets.json": MetaFile(lists.newest("targets")), "site-lab.json": MetaFile(number)}
    repository._sign("snapshot", Snapshot(version=99, meta=meta), online)
    repository._sign("timestamp", Timestamp(version=99, snapshot_meta=MetaFile(99)), online)
    note = client.ready().note
    kind = {"old serial": "rollback", "unlisted": "rollback"}.get(attempt, "signature")
    assert f"version 4 stays active: {kind}: " in note
    assert running(client) == 4
    if attempt == "unlisted":
        assert world.client("victim", trusting=False).ready().wanted.version == 1  # the control


def test_row_10_mondays_folder_on_tuesday(world: World) -> None:
    client, victim = world.client(), world.client("victim", trusting=False)
    assert client.ready().wanted.version == 2
    shutil.copytree(world.trust_folder, world.folder / "monday")
    world.publish(seed=2)
    assert client.ready().wanted.version == victim.ready().wanted.version == 3
    shutil.rmtree(world.trust_folder)
    shutil.copytree(world.folder / "monday", world.trust_folder)
    want(world, 1)
    ready = client.ready()
    assert "version 3 stays active: rollback: " in ready.note
    assert victim.ready().wanted.version == running(victim) == 1  # the control: without lists Tuesday is forgotten
    late = world.client("late")  # and lists cannot tell a robot that never saw Tuesday
    assert late.ready().wanted.version == 1


def test_row_12_news_are_held_back(world: World) -> None:
    """The server's folder stays as it was: robots take nothing new by it after a day, and say how old its word is."""
    client = world.client()
    assert client.ready().note == ""
    world.ahead_s = 31 * 3600.0
    want(world, 1)
    ready = client.ready()
    assert "version 2 stays active: freeze: " in ready.note
    assert client.trust.word_hours == pytest.approx(31.0, abs=0.05)
    ready = world.client("victim", trusting=False).ready()  # the control: without lists no word is ever too old
    assert (ready.wanted.version, ready.note) == (1, "")
    world.ahead_s = 20 * 3600.0  # within its day a word is believed
    assert client.ready().wanted.version == 1


def test_an_offline_day_changes_nothing(world: World) -> None:
    client = world.client()
    manifest = client.manifest(client.ready().wanted)
    world.hub.reachable, world.ahead_s = False, 400 * 86_400.0
    again = world.client()
    ready = again.ready()
    assert ready.wanted.version == 2
    assert len(again.tiles(again.manifest(ready.wanted))[0]) == len(manifest.tiles)
    world.hub.reachable, world.ahead_s = True, 0.0
    world.publish(seed=2)
    assert again.ready().wanted.version == 3


def test_row_14_a_manifest_larger_than_its_signed_size(world: World) -> None:
    """The list says its size: of a larger one the first part ends it."""
    client, victim = world.client(), world.client("victim", trusting=False)
    info = world.store.version(SITE, 2)
    data = world.store.blob(info.manifest_sha256) + bytes(3_000_000)
    world.answer_first("manifests/2", lambda _, question: part_of(data, question))
    with pytest.raises(LinkError, match=f"has {len(data)} bytes where at most {info.manifest_bytes} are expected"):
        client.fetch(client.wanted())
    assert client.chunks.received_bytes <= PART_BYTES
    with pytest.raises(FleetmapError):  # the control: without a signed size it takes them all before it looks
        victim.fetch(victim.wanted())
    assert victim.chunks.received_bytes == len(data)


def test_a_version_that_begins_to_be_run_is_finished(world: World) -> None:
    """A trial takes seconds; what was admitted when it began is made active also where the list has gone on meanwhile."""
    client = world.client()
    first = client.wanted()
    client.fetch(first)
    world.publish(seed=2)
    world.publish(seed=3)
    client.wanted()
    client.activate(client.manifest(first), first)
    assert running(client) == 2
    (world.folder / "cache" / "sites" / SITE / "active").unlink()
    with pytest.raises(UntrustedError, match=r"^rollback: "):
        world.client().manifest(first)  # the control: after a restart it would be new


@pytest.mark.parametrize("versions", [3, 1])
def test_the_server_hears_the_kind_of_attack(world: World, versions: int) -> None:
    clock = {"s": 1000.0}
    sync = world.sync(world.client(), lambda: clock["s"])
    sync.step()
    wanted = sync.fetched.popleft()
    sync.changes.append(VersionChange(wanted, Change.ADOPTED))
    sync.step()
    world.attacker(versions)
    heard = []
    world.bus().subscribe(robot_key(SITE, ROBOT, "ack"), lambda _, payload: heard.append(payload))
    clock["s"] += 61.0
    sync.step()
    last = decode_message(heard[-1], RobotAck)
    assert last.version == 2
    assert last.refused.startswith("signature: ")
    assert not sync.fetched


def test_a_robot_without_a_map_takes_no_strangers_either(world: World) -> None:
    """Elsewhere an incomplete first version is better than none."""
    world.attacker()
    client = world.client("new")
    sync = world.sync(client)
    sync.step()
    assert (list(sync.fetched), running(client)) == ([], None)


def test_a_server_without_lists_is_told_from_an_attack(tmp_path: Path) -> None:
    hub = MemoryHub()
    with MapStore.open(tmp_path / "store", create=True) as store, MemoryBus(hub) as bus, MemoryBus(hub) as robot_bus:
        publish_samples(store, 1)
        service = BusService(store, Fleet(store), bus, lambda *_: None)
        client = MapClient(robot_bus, TileCache(tmp_path / "cache"), SITE, ROBOT)
        client.trust = TrustedMap(tmp_path / "trust", SITE, None, ask_over(robot_bus, SITE, ROBOT))
        with pytest.raises(UntrustedError, match="the server has no signed lists"):
            client.fetch(client.wanted())
        init_here(store)
        update_lists(store)
        client.fetch(client.wanted())  # the control: the same robot, once they are there
        service.close()


def align(world: World, x_m: float, *, is_signed: bool = True) -> None:
    """As `mapserver align` keeps it; unless whatever signs has not looked yet."""
    frame = BuildingFrame(x_m=x_m, y_m=2.0, yaw_rad=0.5)
    found = encode_alignment(Alignment(frame=frame, metres_per_unit=0.05, method="pins"))
    world.store.keep_site_files(SITE, {ALIGNMENT: found, PLAN: b"the drawing"}, "aligned")
    if is_signed:
        update_lists(world.store)


def learned(client: MapClient) -> float | None:
    """Where the robot takes the origin of the map to be in the building, in x."""
    client.wanted()
    data = client.site_file(ALIGNMENT, 10**6)
    return None if data is None else aligned_frame(data).x_m


def followed(world: World, client: MapClient) -> tuple[ServerSync, Callable[[], list[float]]]:
    """The exchange with the server, and what the robot itself has been told of that origin."""
    sync = world.sync(client)
    sync.building = building = BuildingMaps(client, lambda _: client)
    building.refresh(asks=False)
    return sync, lambda: [change.frame.x_m for change in building.changes if change.frame is not None]


def test_a_robot_learns_an_alignment_without_another_version(world: World) -> None:
    client = world.client()
    client.ready()
    assert learned(client) is None
    align(world, 7.0)
    assert learned(client) == 7.0
    assert running(client) == 2
    received = client.chunks.received_bytes
    assert (learned(client), client.chunks.received_bytes) == (7.0, received)
    plan = world.store._database.query("SELECT sha256 FROM site_files WHERE kind = 'plan'", ())[0]["sha256"]
    with pytest.raises(LinkError, match="no published bytes"):
        client.blob(plan, 1000)
    # It is there at the next start, before the server answers, and goes to the robot itself.
    world.hub.reachable = False
    sync, places = followed(world, world.client())
    assert places() == [7.0]
    world.hub.reachable = True
    align(world, 8.0)
    sync.step()
    assert places() == [7.0, 8.0]
    world.store.keep_site_files(SITE, {ALIGNMENT: None}, "forgotten")
    update_lists(world.store)
    assert learned(client) is None


def test_an_alignment_that_nobody_signed_or_that_is_damaged_changes_nothing(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    client = world.client()
    align(world, 7.0)
    assert learned(client) == 7.0
    # A thief of the server's database has no key of the site.
    align(world, 666.0, is_signed=False)
    assert learned(client) == 7.0
    update_lists(world.store)
    assert learned(world.client("control")) == 666.0
    # The bytes are others than those that were signed.
    align(world, 9.0)
    (entry,) = [e for e in SignedLists(world.store.folder).served(SITE).admitted if e.about.state == "current"]  # type: ignore[union-attr]
    path = world.store.folder / blob_path(entry.about.files[ALIGNMENT])
    path.write_bytes(path.read_bytes()[:-1] + b" ")
    sync, places = followed(world, client)
    sync.step()
    assert places() == [7.0]
    assert "stays as it was" in caplog.text
