"""The commands, and `serve` as a process with real HTTP and real zenoh on loopback."""

import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import httpx
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import StoreError, UnreachableError, UsageError
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver import cli, releases
from mapserver.commands.serve import HttpOptions, serve
from mapserver.config import MapserverConfig
from mapserver.store import DraftContent, MapStore
from support.fleet.dashboard_scene import serving
from support.storage.map_samples import draft_details, random_tile

_ENDS = """
import atexit, sys, threading
from mapserver import server
class Kept:
    def __del__(self): print("taken apart", flush=True)
class Reports:
    def flush(self): print("reports are kept", flush=True)
kept = Kept()
atexit.register(print, "at exit")
"""


@pytest.mark.parametrize(
    ("ends", "told"),
    [
        ("server.end_process()", ["at exit"]),
        (
            "server._END_WITHIN_S = 0.2; server._bound_the_end(Reports()); threading.Thread(target=threading.Event().wait).start()",
            ["reports are kept", "at exit"],
        ),
    ],
)
def test_the_process_ends_at_once_whatever_it_holds(ends: str, told: list[str]) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", _ENDS + ends], env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.stdout.splitlines(), done.returncode) == (told, 0), done.stderr


def test_a_server_that_is_killed_in_the_middle_of_a_fetch_is_waited_for(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    with MapStore.open(tmp_path / "store", create=True) as store:
        tiles = [random_tile(rng, landmarks=5000, cell=(x, 0)) for x in range(6)]
        store.save("lab", DraftContent(tiles=tiles, vocabulary=b"words", details=draft_details()))
        releases.publish(store, "lab")
    with ExitStack() as servers:
        served = servers.enter_context(serving(tmp_path / "store"))
        bus = servers.enter_context(Bus(served.zenoh).open())
        through, asked, failed = bus.get, [], []

        def get(key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
            asked.append(key)
            if len(asked) == 6:
                os.kill(served.process, signal.SIGKILL)
                os.waitpid(served.process, 0)
            if len(failed) == 2 and len(asked) < 100:
                asked.extend(["back"] * 100)
                servers.enter_context(serving(tmp_path / "store", "--zenoh", served.zenoh))
            try:
                return through(key, payload, timeout_s=timeout_s)
            except UnreachableError:
                failed.append(key)
                raise

        bus.get = get
        cache = TileCache(tmp_path / "cache")
        link = MapClient(bus, cache, "lab", "r1", timeout_s=0.5, patience_s=60)
        assert link.ready().wanted.version == 1
        assert len(failed) >= 2
        assert cache.active("lab").version == 1
        # Nothing that had come was fetched again.
        assert link.chunks.received_bytes == sum(len(cache.get(sha256)) for sha256 in cache.active("lab").blobs)


def test_wrong_addresses_and_stores_are_told_at_once(tmp_path: Path) -> None:
    context = typer.Context(typer.main.get_command(cli.app), obj=lambda _: (MapserverConfig(), {}))

    def serve_at(http: str, zenoh: str, **more: object) -> None:
        serve(context, tmp_path, HttpOptions(http=http, **more), zenoh)

    with pytest.raises(UsageError, match="--http 'nonsense'"):
        serve_at("nonsense", "tcp/127.0.0.1:0")
    with pytest.raises(UsageError, match="endpoint"):
        serve_at("127.0.0.1:0", "nonsense")
    with pytest.raises(StoreError, match="no map store"):
        serve_at("127.0.0.1:0", "tcp/127.0.0.1:0")
    with pytest.raises(UsageError, match="cannot listen"):
        serve_at("192.0.2.1:80", "tcp/127.0.0.1:0")
    (tmp_path / "no.pem").write_text("no certificate")
    for options, words in (
        ({"http_cert": tmp_path / "no.pem"}, "belong together"),
        ({"http_cert": tmp_path / "no.pem", "http_key": tmp_path / "no.pem"}, "cannot be served"),
    ):
        with pytest.raises(UsageError, match=words):
            serve_at("127.0.0.1:0", "tcp/127.0.0.1:0", **options)


def test_beyond_the_machine_http_is_refused_until_it_is_protected(tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True):
        pass
    arguments = ["--store", str(tmp_path), "--zenoh", "tcp/127.0.0.1:0", "--http", "0.0.0.0:0"]
    for more, words in (
        ([], "--http-cert and --http-key, and add an operator"),
        (
            ["--http", "127.0.0.1:0", "--http-name", "maps.example"],
            "--http-name maps.example can be reached from other",
        ),
    ):
        refused = CliRunner().invoke(cli.app, ["serve", *arguments, *more])
        assert isinstance(refused.exception, UsageError) and words in str(refused.exception)
    with serving(tmp_path, "--insecure", http="0.0.0.0:0") as served:
        address = served.http.replace("0.0.0.0", "127.0.0.1")
        assert httpx.get(f"{address}/v1/sites").status_code == 200
        page = httpx.get(f"{address}/dashboard/", headers={"Accept": "text/html"})
        assert "started with --insecure" in page.text
    assert [line for line in served.log if "WARNING" in line and "started with --insecure" in line]
