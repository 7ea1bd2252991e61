"""A site with mutual TLS on loopback, by the programs: a server that can be stopped and killed, enrolled robots, their daemons."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from locclient.identity import RobotIdentity

START_S = 120.0  # on a machine that may be busy


def forgotten_files(store: Path) -> list[str]:
    """Files of a store that are in no backup, and of which nothing says that they need not be."""
    backed = pytest.importorskip("mapserver.plugins.backups.snapshots")
    names = [path.relative_to(store).as_posix() for path in store.rglob("*") if path.is_file()]
    return [
        n for n in names if not (n.startswith("keys/") or backed.NAMED.fullmatch(n) or backed.LEFT_OUT.fullmatch(n))
    ]


class TlsSite:
    """A store in a folder, and the programs over it."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name, self.store = folder, name, folder / "store"
        self.endpoint, self.http = "tls/127.0.0.1:0", ""
        self.environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "XDG_STATE_HOME": str(folder)}
        self.server: subprocess.Popen[str] | None = None

    def command(self, program: str, *words: object) -> list[str]:
        return [sys.executable, "-m", f"{program}.cli", *map(str, words)]

    def run(self, program: str, *words: object) -> str:
        """Both outputs of a program; its status is 0 unless they begin with an error."""
        command = self.command(program, *words)
        done = subprocess.run(
            command, env=self.environment, capture_output=True, text=True, timeout=START_S, check=False
        )
        assert (done.returncode == 0) == ("error: " not in done.stderr), done.stderr
        return done.stdout + done.stderr

    def start(self) -> None:
        """Starts the server, again under the address that it had before."""
        words = ("serve", "--store", self.store, "--http", "127.0.0.1:0", "--zenoh", self.endpoint)
        with (self.folder / "server.log").open("ab") as log:
            command = self.command("mapserver", *words)
            self.server = subprocess.Popen(command, env=self.environment, stdout=subprocess.PIPE, stderr=log, text=True)
        said = dict(line.strip().split(": ", 1) for line in iter(self.server.stdout.readline, "ready\n"))
        self.http, self.endpoint = said["http"], said["zenoh"]

    def stop(self, number: int = signal.SIGTERM) -> int:
        """The status with which the server ends. Whatever it wrote is in a backup, or need not be."""
        if self.server is None:
            return 0
        self.server.send_signal(number)
        status = self.server.wait(timeout=60)
        self.server.stdout.close()
        self.server = None
        assert forgotten_files(self.store) == []
        return status

    @contextmanager
    def serving(self, endpoint: str | None = None) -> Iterator[None]:
        """A server from now on until the block's end; endpoint: another one than before."""
        self.endpoint = endpoint or self.endpoint
        self.start()
        try:
            yield
        finally:
            assert self.stop() == 0

    def enrol(self, robot: str) -> RobotIdentity:
        where = ("--site", self.name, "--store", self.store, "--endpoint", self.endpoint, "--out", self.folder)
        self.run("mapserver", "robots", "enrol", robot, *where)
        told = self.run("locclient", "enrol", self.folder / f"{robot}.fleetmap", "--identity", self.folder / robot)
        assert f"enrolled as {robot} of site {self.name}" in told
        return RobotIdentity.load(self.folder / robot)

    def configure(self, robot: str, source: str) -> Path:
        """The configuration of an enrolled robot's daemon; source: lines of [source]."""
        path = self.folder / f"{robot}.toml"
        path.write_text(
            f'[run]\nidentity = "{self.folder / robot}"\ncache = "{self.folder / robot}-cache/tiles"\n'
            f'outbox = "{self.spool(robot)}"\nfailures = "{self.failures(robot)}"\n[source]\n{source}\n'
        )
        return path

    def spool(self, robot: str) -> Path:
        return self.folder / f"{robot}-cache" / "spool" / f"{self.name}.{robot}.sqlite3"

    def failures(self, robot: str) -> Path:
        """The folder in which the daemon keeps the reports that it makes."""
        return self.folder / f"{robot}-failures"

    @contextmanager
    def daemon(self, robot: str) -> Iterator[subprocess.Popen[bytes]]:
        """`locclient run` as configured; killed at the end if it still runs."""
        command = self.command("locclient", "run", "--config", self.folder / f"{robot}.toml", "--verbose")
        with (
            self.log(robot).open("ab") as log,
            subprocess.Popen(command, env=self.environment, stdout=log, stderr=log) as process,
        ):
            try:
                yield process
            finally:
                process.kill()

    def log(self, robot: str) -> Path:
        return self.folder / f"{robot}.log"

    def robot(self, name: str) -> dict[str, Any]:
        """The server's entry of a robot; empty if unknown or without a reply."""
        try:
            answer = httpx.get(f"{self.http}/v1/robots", params={"site": self.name}, timeout=10, verify=False)
            told = answer.json()["items"]
        except httpx.HTTPError:
            return {}
        return next((one for one in told if one["robot"] == name), {})
