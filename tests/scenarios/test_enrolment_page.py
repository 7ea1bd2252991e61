"""The commands of "Enrolling robots" in docs/security.md, as they stand there, between two network namespaces.

Two robots reach the server over TLS, one is revoked. Needs root and `ip netns`; what is typed comes from the page alone, with a
folder of this test in the place of DIR, and the server's name in the hosts file of the robots' machine.
"""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from mapserver import releases
from mapserver.store import MapStore
from support.fleet.contracts_documents import REPOSITORY
from support.storage.map_samples import save_sample_draft

SERVER_IP, ROBOTS_IP = "10.213.77.1", "10.213.77.2"
ROBOTS = ("tug-7", "tug-8")
_COMMAND = re.compile(r"`((?:mapserver|locclient) [^`]* [^`]*)`", re.DOTALL)


def page_commands() -> list[str]:
    """What the page tells to type, in its order; words that only name a command have no arguments."""
    page = (REPOSITORY / "docs" / "security.md").read_text("utf-8")
    section = page.split("\n### Enrolling robots\n")[1].split("\n#")[0]
    return [" ".join(match.split()) for match in _COMMAND.findall(section)]


def test_the_page_has_these_steps() -> None:
    assert [" ".join(command.split()[:3]) for command in page_commands()] == [
        "mapserver trust init",
        "mapserver serve --store",
        "mapserver robots enrol",
        "locclient enrol tug-7.fleetmap",
        "mapserver robots list",
        "mapserver robots revoke",
    ]


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, timeout=20)


class Machine:
    """A network namespace with a hosts file of its own, and who works on it."""

    def __init__(self, name: str, folder: Path, store: Path) -> None:
        self.name, self.folder, self._store = name, folder, store
        folder.mkdir()

    def command(self, words: str) -> list[str]:
        program, *arguments = words.replace("DIR", str(self._store)).split()
        return ["ip", "netns", "exec", self.name, sys.executable, "-m", f"{program}.cli", *arguments]

    @property
    def environment(self) -> dict[str, str]:
        homes = {f"XDG_{kind}_HOME": str(self.folder / kind) for kind in ("STATE", "CACHE")}
        return os.environ | homes | {"PYTHONPATH": os.pathsep.join(sys.path)}

    def type(self, words: str, fails: str = "") -> str:
        """Both outputs; the command must do its work, or fail with these words."""
        how = {"cwd": self.folder, "env": self.environment, "capture_output": True, "text": True, "timeout": 120}
        done = subprocess.run(self.command(words), check=False, **how)
        assert (fails in done.stderr) if fails else done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        return done.stdout + done.stderr

    def checks(self) -> dict[str, str]:
        """What `locclient check` says of the way to the server."""
        (self.folder / "robot.toml").write_text("")
        how = {"cwd": self.folder, "env": self.environment, "capture_output": True, "text": True, "timeout": 120}
        command = self.command("locclient check --config robot.toml --seconds 0")
        lines = subprocess.run(command, check=False, **how).stdout.splitlines()
        return {line.split(":")[0].split(maxsplit=1)[1]: line for line in lines}


@contextmanager
def two_machines(folder: Path, store: Path) -> Iterator[tuple[Machine, Callable[[str], Machine]]]:
    """The server's machine, and robots (each with a folder of its own) on another, joined by one cable."""
    mark = f"fm{os.getpid()}"
    server, robots = f"{mark}s", f"{mark}r"
    hosts = [Path("/etc/netns") / name for name in (server, robots)]
    try:
        for name in (server, robots):
            ip("netns", "add", name)
            ip("-n", name, "link", "set", "lo", "up")
        ip("-n", server, "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", robots)
        for name, address in ((server, SERVER_IP), (robots, ROBOTS_IP)):
            ip("-n", name, "addr", "add", f"{address}/30", "dev", "cable")
            ip("-n", name, "link", "set", "cable", "up")
        for place in hosts:
            place.mkdir(parents=True)
            (place / "hosts").write_text(f"127.0.0.1 localhost\n{SERVER_IP} maps.example\n")
        yield Machine(server, folder / "server", store), lambda robot: Machine(robots, folder / robot, store)
    finally:
        for name in (server, robots):
            subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True, timeout=20)
        for place in hosts:
            shutil.rmtree(place, ignore_errors=True)


@contextmanager
def served(machine: Machine, words: str) -> Iterator[None]:
    process = subprocess.Popen(
        machine.command(words), cwd=machine.folder, env=machine.environment, stdout=subprocess.PIPE, text=True
    )
    try:
        assert [process.stdout.readline() for _ in range(3)][1:] == ["zenoh: tls/0.0.0.0:7447\n", "ready\n"]
        yield
    finally:
        process.terminate()
        process.wait(timeout=30)
        process.stdout.close()


def can_make_namespaces() -> str:
    """Why not; empty where it can be done."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        return "root and iproute2"
    made = subprocess.run(["ip", "netns", "add", "fleetmap-try"], check=False, capture_output=True, text=True)
    subprocess.run(["ip", "netns", "del", "fleetmap-try"], check=False, capture_output=True)
    return "" if made.returncode == 0 else f"`ip netns add` ({made.stderr.strip()})"


@pytest.mark.timeout(300)
def test_a_new_user_follows_the_page(tmp_path: Path) -> None:
    if missing := can_make_namespaces():
        pytest.skip(f"NO NETWORK NAMESPACES: the page about enrolment is not tried; it needs {missing}")
    init, serve, enrol, on_robot, listing, revoke = page_commands()
    with MapStore.open(tmp_path / "store", create=True) as store:
        save_sample_draft(store, site="hall")
        releases.publish(store, "hall")
    with two_machines(tmp_path, tmp_path / "store") as (server, on_network):
        server.type(serve, fails="mapserver trust init --here")
        server.type(init)
        with served(server, serve):
            server.type(enrol)
            robots = {name: on_network(name) for name in ROBOTS}
            for name, robot in robots.items():
                shutil.move(server.folder / f"{name}.fleetmap", robot.folder)  # the stick
                told = robot.type(on_robot.replace("tug-7", name))
                assert f"enrolled as {name} of site hall at tls/maps.example:7447" in told
            assert server.type(listing).count("certificate for 365 days") == len(ROBOTS)
            for robot in robots.values():
                said = robot.checks()
                assert said["connection"].startswith("ok"), said
                assert "tls/maps.example:7447 wants version 1" in said["connection"]
                assert "admits version 1" in said["signed list"]
            server.type(revoke)
            until_s = time.monotonic() + 30  # the page's two seconds are measured by bench_bus_access
            while "lets this certificate say nothing" not in (said := robots["tug-7"].checks()["connection"]):
                assert time.monotonic() < until_s, said
            assert robots["tug-8"].checks()["connection"].startswith("ok")
