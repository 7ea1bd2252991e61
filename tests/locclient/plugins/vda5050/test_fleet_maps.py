"""Downloads that must not become maps of a robot, and the one that may."""

import hashlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import pytest

from fleetmap.errors import FleetmapError, LinkError, MapFormatError, StateError, UntrustedError, UsageError
from fleetmap.messages import WantedVersion
from locclient.maps.tile_cache import TileCache
from locclient.plugins.vda5050 import fleet_maps
from locclient.plugins.vda5050.actions import RefusedActionError
from locclient.plugins.vda5050.fleet_maps import FleetMaps, Origins
from mapserver.store import MapStore
from support.storage.map_samples import publish_samples


@contextmanager
def web_server(answer: Callable[[BaseHTTPRequestHandler], None]) -> Iterator[str]:
    class Handler(BaseHTTPRequestHandler):
        do_GET = answer  # noqa: N815
        log_message = lambda *_: None  # noqa: E731

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()


def serve(data: bytes, status: int = 200, **headers: str) -> Callable[[BaseHTTPRequestHandler], None]:
    def answer(request: BaseHTTPRequestHandler) -> None:
        request.send_response(status)
        for name, value in ({"Content-Length": str(len(data))} | headers).items():
            request.send_header(name, value)
        request.end_headers()
        request.wfile.write(data)

    return answer


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Version 1 of site lab."""
    folder = tmp_path_factory.mktemp("store")
    with MapStore.open(folder / "store", create=True) as store:
        publish_samples(store, 1)
        store.export_version("lab", 1, folder / "file", archive=False)
    return (folder / "file").read_bytes()


class Robot:
    """A cache, and a signed list that admits everything until it is told otherwise."""

    def __init__(self, folder: Path, *allowed: str, max_bytes: int = 10**8) -> None:
        self.asked: list[WantedVersion] = []
        self.fault: FleetmapError | None = None
        self.cache = TileCache(folder / "cache", max_bytes=max_bytes)
        self.folder, self.site = self.cache.folder / "incoming", "lab"
        self.trust = SimpleNamespace(refresh=lambda: None, admitted=self._check)
        self.maps = FleetMaps(self, Origins(allowed))  # type: ignore[arg-type]

    def _check(self, wanted: WantedVersion) -> None:
        self.asked.append(wanted)
        if self.fault is not None:
            raise self.fault

    def refuses(
        self, kind: type[Exception], words: str, link: str, sha256: str | None = None, version: int = 1
    ) -> None:
        """The download fails, and leaves nothing behind."""
        before = self.maps.versions(), self.cache.total_bytes
        with pytest.raises(kind, match=words):
            self.maps.download(version, link, sha256)
        assert (self.maps.versions(), self.cache.total_bytes) == before
        assert list(self.folder.iterdir()) == []


def test_a_version_is_taken_kept_and_deleted(tmp_path: Path, file: bytes) -> None:
    with web_server(serve(file)) as http:
        robot = Robot(tmp_path, http)
        robot.maps.download(1, f"{http}/file", hashlib.sha256(file).hexdigest().upper())
        assert robot.maps.versions() == [(1, False)]
        assert [wanted.version for wanted in robot.asked] == [1]
        robot.refuses(RefusedActionError, "on the robot already", f"{http}/file")
    again = Robot(tmp_path, http)
    assert again.maps.versions() == [(1, False)], "it survives a restart"
    assert again.maps.wanted(1) == robot.asked[0]
    again.fault = UntrustedError("rollback", "withdrawn")
    with pytest.raises(UntrustedError, match="withdrawn"):
        again.maps.wanted(1)
    with pytest.raises(StateError, match="in use"):
        again.maps.delete(1, {1})
    again.maps.delete(1, set())
    assert (again.maps.versions(), again.cache.total_bytes) == ([], 0)
    with pytest.raises(StateError, match="not on the robot, which has none"):
        again.maps.delete(1, set())


def test_files_that_are_not_the_map_leave_nothing(tmp_path: Path, file: bytes) -> None:
    spoiled = bytearray(file)
    spoiled[len(file) // 2] ^= 1
    for data, words in (
        (bytes(spoiled), "is not a complete export|damaged|SHA-256"),
        (file[:-9], "does not fit"),
        (b"<html>not found</html>" * 9, "is another kind of file"),
        (b"", "too few"),
    ):
        with web_server(serve(data)) as http:
            Robot(tmp_path, http).refuses(MapFormatError, words, f"{http}/file")
    with web_server(serve(file)) as http:
        robot = Robot(tmp_path, http)
        robot.refuses(LinkError, "the fleet manager named 00", f"{http}/file", "00" * 32)
        robot.refuses(MapFormatError, "holds version 1 of lab, wanted was 7", f"{http}/file", version=7)
        robot.fault = UntrustedError("signature", "not in the signed list")
        robot.refuses(UntrustedError, "not in the signed list", f"{http}/file")
        robot.fault = None
        roomy = Robot(tmp_path / "b", http, max_bytes=2 * len(file) + 2)
        roomy.maps.download(1, f"{http}/file", None)
        assert roomy.maps.versions() == [(1, False)]


def test_links_lead_to_named_servers_alone(tmp_path: Path, file: bytes) -> None:
    asked: list[str] = []

    def remember(request: BaseHTTPRequestHandler) -> None:
        asked.append(request.path)
        serve(file)(request)

    with web_server(remember) as other, web_server(serve(b"", 302, Location=f"{other}/file")) as http:
        robot = Robot(tmp_path, http)
        robot.refuses(LinkError, "points to", f"{other}/file")
        robot.refuses(LinkError, "answers 302", f"{http}/file")  # redirections are not followed
        host, rest = http.removeprefix("http://"), other.removeprefix("http://")
        links = f"http://{host}@{rest}/file", f"{http}.evil.example/file", f"https://{host}/file"
        for link in (*links, "file:///etc/passwd", f"{http}/fi\r\nHost: x", "http://[::1/x", ""):
            robot.refuses(LinkError, "link", link)
    assert asked == []
    with pytest.raises(LinkError, match="from nowhere"):
        Origins(()).admit("https://maps.example/file")
    origins = {"maps.example": "not like", "https://maps.example/x": "not like", "http://10.0.0.1": "TLS"}
    for origin, words in origins.items():
        with pytest.raises(UsageError, match=words):
            Origins((origin,)).check()


def test_bodies_and_heads_without_end_and_servers_that_hang_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: bytes
) -> None:
    def endless(request: BaseHTTPRequestHandler) -> None:
        request.send_response(200)
        request.end_headers()
        with suppress(OSError):
            for _ in range(10_000):
                request.wfile.write(b"\0" * 65536)

    def endless_head(request: BaseHTTPRequestHandler) -> None:
        with suppress(OSError):
            while True:
                request.wfile.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    with monkeypatch.context() as patch, web_server(endless_head) as http:
        patch.setattr(fleet_maps, "_STALL_S", 0.3)
        Robot(tmp_path, http).refuses(LinkError, "cannot be fetched", f"{http}/file")
    with web_server(endless) as http:
        Robot(tmp_path, http, max_bytes=1_000_000).refuses(RefusedActionError, "more than 500000", f"{http}/file")
    with web_server(serve(file)) as http:
        words = f"{len(file)} bytes, the limit is {len(file) // 2}"
        Robot(tmp_path, http, max_bytes=len(file)).refuses(RefusedActionError, words, f"{http}/file")
    with web_server(serve(b"short", **{"Content-Length": "5000"})) as http:
        Robot(tmp_path, http).refuses(LinkError, "fetched|early", f"{http}/file")
    with web_server(serve(b"", 404)) as http:
        Robot(tmp_path, http).refuses(LinkError, "404", f"{http}/file")
    Robot(tmp_path, http).refuses(LinkError, "cannot be fetched", f"{http}/file")
