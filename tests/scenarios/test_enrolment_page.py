"""The commands of "Enrolling robots" in docs/security.md, as they stand there: two robots reach the server over TLS, one is revoked.

What is typed comes from the page alone, with a folder of this test in the place of DIR. All run in a network namespace, in which nobody
else has the page's port and whose hosts file knows the page's server. Needs root and `ip netns`.
"""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mapserver import releases
from mapserver.store import MapStore
from support.fleet.contracts_documents import REPOSITORY
from support.storage.map_samples import save_sample_draft

ROBOTS = ("tug-7", "tug-8")
_COMMAND = re.compile(r"`((?:mapserver|locclient) [^`]* [^`]*)`", re.DOTALL)
_STEPS = [
    "mapserver trust init", "mapserver serve --store", "mapserver robots enrol", "locclient enrol tug-7.fleetmap",
    "mapserver robots list", "mapserver robots revoke",
]  # fmt: skip


class Machine:
    """A network namespace with a hosts file of its own, and the store that stands for DIR."""

    def __init__(self, store: Path) -> None:
        self.name, self._store = f"fm{os.getpid()}", store
        self._hosts = Path("/etc/netns") / self.name

    def start(self) -> None:
        for words in (["netns", "add", self.name], ["-n", self.name, "link", "set", "lo", "up"]):
            subprocess.run(["ip", *words], check=True, capture_output=True, timeout=20)
        self._hosts.mkdir(parents=True)
        (self._hosts / "hosts").write_text("127.0.0.1 localhost maps.example\n")

    def close(self) -> None:
        subprocess.run(["ip", "netns", "del", self.name], check=False, capture_output=True, timeout=20)
        shutil.rmtree(self._hosts, ignore_errors=True)

    def begin(self, words: str, folder: Path) -> subprocess.Popen[str]:
        """A command in a folder of its user's."""
        folder.mkdir(exist_ok=True)
        program, *arguments = words.replace("DIR", str(self._store)).split()
        homes = {f"XDG_{kind}_HOME": str(folder / kind) for kind in ("STATE", "CACHE")}
        environment = os.environ | homes | {"PYTHONPATH": os.pathsep.join(sys.path)}
        command = ["ip", "netns", "exec", self.name, sys.executable, "-m", f"{program}.cli", *arguments]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, cwd=folder, env=environment, text=True, **pipes)

    def type(self, words: str, folder: Path, fails: str | None = None) -> str:
        """Both outputs; the command must do its work, or fail with these words."""
        process = self.begin(words, folder)
        output, errors = process.communicate(timeout=120)
        assert process.returncode == 0 if fails is None else fails in errors, f"{words}: {output}{errors}"
        return output + errors

    def connection(self, folder: Path) -> str:
        """What `locclient check` says of the way to the server."""
        (folder / "robot.toml").write_text("")
        process = self.begin("locclient check --config robot.toml --seconds 0", folder)
        output = process.communicate(timeout=120)[0]
        return next(line for line in output.splitlines() if line.split(":")[0].endswith("connection"))


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    made = Machine(tmp_path / "store")
    try:
        try:
            made.start()
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(
                f"NO NETWORK NAMESPACES: the page about enrolment is not tried ({error}); it needs root and iproute2"
            )
        yield made
    finally:
        made.close()


@pytest.mark.timeout(600)
def test_a_new_user_follows_the_page(machine: Machine, tmp_path: Path) -> None:
    page = (REPOSITORY / "docs" / "security.md").read_text("utf-8").split("\n### Enrolling robots\n")[1].split("\n#")[0]
    commands = [" ".join(match.split()) for match in _COMMAND.findall(page)]
    assert [" ".join(command.split()[:3]) for command in commands] == _STEPS
    init, serve, enrol, on_robot, listing, revoke = commands
    with MapStore.open(tmp_path / "store", create=True) as store:
        save_sample_draft(store, site="hall")
        releases.publish(store, "hall")
    server, robots = tmp_path / "server", {name: tmp_path / name for name in ROBOTS}
    machine.type(serve, server, fails="mapserver trust init --here")
    machine.type(init, server)
    process = machine.begin(serve, server)
    try:
        assert process.stdout is not None
        assert [process.stdout.readline() for _ in range(3)][1:] == ["zenoh: tls/0.0.0.0:7447\n", "ready\n"]
        machine.type(enrol, server)
        for name, folder in robots.items():
            folder.mkdir()
            shutil.move(server / f"{name}.fleetmap", folder)  # the stick
            told = machine.type(on_robot.replace("tug-7", name), folder)
            assert f"enrolled as {name} of site hall at tls/maps.example:7447" in told
        assert machine.type(listing, server).count("certificate for 365 days") == len(ROBOTS)
        for folder in robots.values():
            assert "tls/maps.example:7447 wants version 1" in machine.connection(folder)
        machine.type(revoke, server)
        until_s = time.monotonic() + 60  # the page's two seconds are measured by bench_enrolled
        while "lets this certificate say nothing" not in (said := machine.connection(robots["tug-7"])):
            assert time.monotonic() < until_s, said
        assert machine.connection(robots["tug-8"]).startswith("ok")
    finally:
        process.terminate()
        process.communicate(timeout=30)
