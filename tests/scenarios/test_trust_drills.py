"""Thefts and recoveries with the programs: `serve` as a process, the root key's acts by their commands, a robot on the bus.

Each drill shows first what the thief achieves, or tries, and then the way back.
"""

import getpass
import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest
from tuf.api.metadata import MetaFile, Snapshot, Timestamp

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import FleetmapError
from fleetmap.messages import WantedVersion
from fleetmap.trust.site_list import AdmittedVersion, VersionState
from fleetmap.trust.trusted_map import TrustedMap, ask_over
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver import cli, releases
from mapserver.store import MapStore
from mapserver.trust import KeyFolder, SignedLists
from mapserver.trust.repository import ListRepository, site_targets
from mapserver.trust.signing import init_offline
from support.fleet.dashboard_scene import serving
from support.room_site import invoke
from support.storage.map_samples import publish_samples, save_sample_draft

SITE, YEAR_NS = "lab", 365 * 86_400_000_000_000
FORGED = "f" * 64


class Drill:
    """A store whose root key lies on a stick, its server, and robots."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.store, self.lists = folder, folder / "store", SignedLists(folder / "store")
        self.stick = folder / "stick"
        self.words: dict[str, str] = {}
        monkeypatch.setattr(getpass, "getpass", lambda prompt: self.words[prompt.split()[-1].rstrip(":")])

    def run(self, *words: object, fails: str = "") -> str:
        """`mapserver trust` with these words."""
        result = invoke(cli.app, "trust", *words, "--store", self.store)
        if fails:
            assert isinstance(result.exception, FleetmapError), result.output
            assert fails in str(result.exception)
        else:
            assert result.exit_code == 0, (result.output, result.exception)
        self.words |= dict(re.findall(r"(\S+\.pem): (\S+)", result.output))
        return result.output

    @property
    def key(self) -> list[object]:
        """The option that names the first root key."""
        return ["--key", self.stick / "root-1.pem"]

    def robot(self, name: str) -> "Robot":
        return Robot(self, self.robots.enter_context(Bus(self.endpoint).open()), name)

    def publish(self, seed: int) -> None:
        with MapStore.open(self.store) as store:
            save_sample_draft(store, seed=seed)
            releases.publish(store, SITE)

    @contextmanager
    def thief(self) -> Iterator[ListRepository]:
        """The server's folder of lists as a thief may write into it; at the end it is as it was."""
        before = self.folder / "before"
        shutil.copytree(self.lists.folder, before)
        yield ListRepository(self.store, datetime.now(UTC))
        # The server is at work in the folder: nothing is deleted under it.
        self.lists.folder.rename(self.folder / "stolen")
        before.rename(self.lists.folder)


class Robot:
    """A robot that trusts the first root of the drill's store."""

    def __init__(self, drill: Drill, bus: Bus, name: str) -> None:
        folder, root = drill.folder / name, (drill.lists.folder / "1.root.json").read_bytes()
        self.client = MapClient(bus, TileCache(folder), SITE, name)
        self.trust = TrustedMap(folder / "trust", SITE, root, ask_over(bus, SITE, name))
        self.client.trust = self.trust

    def ready(self) -> tuple[int | None, str]:
        """The version that it runs now, and why not the wanted one."""
        found = self.client.ready()
        return found.wanted.version, found.note

    def takes(self, version: int, sha256: str) -> bool:
        self.trust.refresh()
        try:
            self.trust.admitted(WantedVersion(site=SITE, version=version, manifest_sha256=sha256))
        except FleetmapError:
            return False
        return True


@contextmanager
def served(drill: Drill) -> Iterator[None]:
    with serving(drill.store) as server, ExitStack() as drill.robots:
        drill.endpoint = server.zenoh
        yield


@pytest.fixture
def drill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Drill]:
    """Versions 1 (previous) and 2 (current) of site lab."""
    made = Drill(tmp_path, monkeypatch)
    with MapStore.open(made.store, create=True) as store:
        publish_samples(store, 2)
    made.run("init", "--stick", made.stick)
    made.run("admit", SITE, *made.key)
    with served(made):
        yield made


def sign_online(repository: ListRepository, drill: Drill, number: int, site_list: int) -> None:
    """Snapshot and timestamp of this number with the server's own key, as a thief of it can make them."""
    online = KeyFolder(drill.store / "keys").signer("online")
    meta = {"targets.json": MetaFile(drill.lists.newest("targets")), f"site-{SITE}.json": MetaFile(site_list)}
    repository._sign("snapshot", Snapshot(version=number, meta=meta), online)
    repository._sign("timestamp", Timestamp(version=number, snapshot_meta=MetaFile(number)), online)


def test_the_online_key_is_stolen(drill: Drill) -> None:
    robot = drill.robot("r1")
    assert robot.ready() == (2, "")
    with drill.thief() as repository:
        sign_online(repository, drill, 100, drill.lists.newest("site-lab"))
        assert robot.ready() == (2, "")
        assert not robot.takes(99, FORGED)
    drill.publish(seed=2)
    version, note = robot.ready()
    assert version == 2  # it believed the thief's numbers, and refuses the honest server for it
    assert "rollback: " in note
    drill.run("rotate", "online", fails="name the file of the root key by --key")
    drill.run("rotate", "online", *drill.key)
    assert robot.ready() == (3, "")


def test_the_sites_key_is_stolen(drill: Drill) -> None:
    robot = drill.robot("r1")
    assert robot.ready() == (2, "")
    number = 2**31 - 1
    with drill.thief() as repository:
        about = VersionState(version=99, state="current", vocabulary="0" * 64)
        key = KeyFolder(drill.store / "keys").signer(f"site-{SITE}")
        repository._sign(f"site-{SITE}", site_targets(SITE, [AdmittedVersion(FORGED, 500, about)], number), key)
        sign_online(repository, drill, 50, number)
        assert robot.takes(99, FORGED)  # nothing stops a thief of both: the control
    drill.publish(seed=2)
    assert "rollback: " in robot.ready()[1]
    drill.run("admit", SITE, *drill.key)
    assert "rollback: " in robot.ready()[1]  # another key of the site alone does not bring robots back
    drill.run("revoke", SITE, *drill.key)
    assert robot.ready() == (3, "")
    assert not robot.takes(99, FORGED)
    assert drill.robot("r2").ready() == (3, "")


def test_the_root_key_is_replaced(drill: Drill) -> None:
    """A stick is worn out, or its holder leaves: robots that know the first root alone follow over all later ones."""
    robot, late = drill.robot("r1"), drill.robot("late")
    assert robot.ready() == (2, "")
    drill.run("rotate", "root", *drill.key, "--stick", drill.folder / "new")
    new = ["--key", drill.folder / "new" / "root-2.pem"]
    for _ in range(3):
        drill.run("rotate", "root", *new)
    drill.run("rotate", "root", *drill.key, fails="is not the root key of")
    drill.run("rotate", "online", *new)
    drill.publish(seed=2)
    assert drill.lists.newest("root") == 6
    assert robot.ready() == (3, "")
    assert late.ready() == (3, "")


def test_the_root_expires(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Made two years and a day ago, and nobody signed it in time."""
    drill = Drill(tmp_path, monkeypatch)
    before_ns = int(datetime.now(UTC).timestamp() * 1e9) - 2 * YEAR_NS - YEAR_NS // 365
    with MapStore.open(drill.store, create=True, clock_ns=lambda: before_ns) as store:
        publish_samples(store, 2)
        path, words = init_offline(store, drill.stick)
        drill.words = {str(path): words}
    drill.run("admit", SITE, *drill.key)
    with served(drill):
        robot = drill.robot("r1")
        robot.client.trust = None
        assert robot.ready() == (2, "")  # what it has, from a time when all was valid
        robot.client.trust = robot.trust
        drill.publish(seed=2)
        version, note = robot.ready()
        assert version == 2
        assert "version 2 stays active: freeze: " in note
        result = invoke(cli.app, "trust", "status", "--store", drill.store)
        assert result.exit_code == 1
        assert "root: expired: robots refuse new maps" in result.output
        drill.run("rotate", "root", *drill.key)
        assert robot.ready() == (3, "")
        drill.run("status")
