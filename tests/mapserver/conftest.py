"""Places of a store: its folder, an object store, PostgreSQL; a browser. Disks have room, whatever this machine's have."""

import os
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Page, expect

import mapserver
from mapserver.store import MapStore
from mapserver.store.places import Places, write_places
from support.command_line import status as status_of
from support.fleet.dashboard_scene import ROBOTS, Served, fill_store, serving, talking, watch
from support.fleet.quick_passwords import use_quick_passwords
from support.fleet.served_world import World, served_world
from support.pages.browser import Chromium, running_chromium
from support.recordings.recording_samples import write_mcap
from support.storage.clock import Clock
from support.storage.postgres_server import PostgresServer, postgres_server
from support.storage.s3_server import KEYS, s3_server
from support.waiting import eventually
from support.worlds.box_room import there_and_back

HAS_REMOTE = (Path(mapserver.__path__[0]) / "plugins" / "remote_stores").is_dir()
expect.set_options(timeout=30_000)  # a busy machine answers late


@pytest.fixture(autouse=True)
def free_bytes(monkeypatch) -> list[int]:
    """What is free on every disk that this process asks for: a terabyte, unless a test says otherwise."""
    statvfs, free = os.statvfs, [1 << 40]

    def measured(path: int | Path) -> os.statvfs_result:
        found = list(statvfs(path))
        found[1:5] = [1, 2 << 40, *free * 2]  # bytes: a block's size, all, free, free for us
        return os.statvfs_result(found)

    monkeypatch.setattr(os, "statvfs", measured)
    return free


@pytest.fixture(autouse=True)
def quick_passwords(monkeypatch) -> None:
    use_quick_passwords(monkeypatch)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[MapStore]:
    """A new store, whose time is the clock's."""
    with MapStore.open(tmp_path / "store", create=True, clock_ns=clock) as opened:
        yield opened


@pytest.fixture(scope="session")
def room_ride(tmp_path_factory) -> Path:
    """A recording of six seconds along a wall of the room, and back."""
    return write_mcap(tmp_path_factory.mktemp("recordings") / "ride", there_and_back())


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """A server and a robot of it, on the bus in memory."""
    with served_world(tmp_path) as made:
        yield made


@pytest.fixture(scope="session")
def s3_bucket(tmp_path_factory) -> Iterator[str]:
    """The URL of a bucket in an S3 server, whose address and credentials are in the environment."""
    with s3_server(tmp_path_factory.mktemp("s3")) as address, pytest.MonkeyPatch.context() as patch:
        for name, value in (KEYS | {"AWS_ENDPOINT_URL": address}).items():
            patch.setenv(name, value)
        yield "s3://fleet"


@pytest.fixture
def s3(s3_bucket: str, tmp_path: Path) -> str:
    """The URL of an empty place in that bucket."""
    return f"{s3_bucket}/{tmp_path.name}"


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    with postgres_server() as server:
        yield server


@pytest.fixture(params=["folder", *(("s3", "postgres") if HAS_REMOTE else ())])
def store_folder(request, tmp_path: Path) -> Path:
    """The folder of a new store, whose content is there or in S3, and its metadata there or in PostgreSQL."""
    folder = tmp_path / "store"
    if request.param != "folder":
        folder.mkdir()
        content = request.getfixturevalue("s3") if request.param == "s3" else None
        database = None if content else request.getfixturevalue("postgres").database()
        write_places(folder, Places(content, database))
    return folder


@pytest.fixture(params=["sqlite", *(("postgres",) if HAS_REMOTE else ())])
def metadata_folder(request, tmp_path: Path) -> Path:
    """The folder of a new store, whose metadata is there or in PostgreSQL."""
    if request.param == "postgres":
        write_places(tmp_path, Places(database=request.getfixturevalue("postgres").database()))
    return tmp_path


@pytest.fixture(scope="module")
def browser() -> Iterator[Chromium]:
    # The second name is how a page from elsewhere would reach loopback.
    with running_chromium("--host-resolver-rules=MAP elsewhere.example 127.0.0.1") as started:
        yield started


@pytest.fixture(scope="module")
def served(browser: Chromium, tmp_path_factory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("store")
    fill_store(folder)
    with serving(folder) as server:
        with talking(server.zenoh, ROBOTS):
            here = lambda: httpx.get(f"{server.http}/v1/robots?limit=1000", verify=False).json()["items"]  # noqa: E731
            assert eventually(lambda: len(here()) >= ROBOTS, 30.0)
        yield server
    assert [line for line in server.log if "ERROR" in line or "Traceback" in line] == []


@pytest.fixture
def page(browser: Chromium) -> Iterator[Page]:
    """A page that asks one server alone and has no faults, but for those that its test expects and clears."""
    with browser.context(ignore_https_errors=True, viewport={"width": 1280, "height": 900}) as context:
        seen = watch(made := context.new_page())
        yield made
        assert seen.faults == []
        assert len(seen.servers()) == 1


@pytest.fixture
def run(capsys):
    """The command line in this process."""

    def run(*arguments: object, status: int = 0) -> str:
        found = status_of("mapserver", *arguments)
        told = capsys.readouterr()
        assert found == status, told.err
        return told.out + told.err

    return run
