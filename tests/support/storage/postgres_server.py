"""A PostgreSQL server of Debian's package on this machine, with a new database for who asks."""

import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fleetmap.bus.endpoints import with_free_port

_BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin"))


class PostgresServer:
    """url: of the server, without a database."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, 0
        # It refuses to run as root.
        self._account = {"user": "postgres", "group": "postgres"} if os.geteuid() == 0 else {}
        if self._account:
            shutil.chown(folder, "postgres", "postgres")
        self._port = with_free_port("tcp/127.0.0.1:0").rpartition(":")[2]
        self._run("initdb", "-D", str(folder / "data"), "-A", "trust", "-U", "fleet", "--no-sync", "-E", "UTF8")
        self.start()

    def start(self, certificate: Path | None = None) -> None:
        """Start it as a process that ends with this one, even if this one is killed. certificate: with its key, for TLS."""
        become = ["--reuid", "postgres", "--regid", "postgres", "--clear-groups"] if self._account else []
        settings = [f"port={self._port}", "listen_addresses=127.0.0.1", "unix_socket_directories=", "fsync=off"]
        if certificate is not None:
            own = shutil.copy(certificate, self._folder / "data" / "server.pem")
            own.chmod(0o600)
            if self._account:
                shutil.chown(own, "postgres", "postgres")
            settings += ["ssl=on", f"ssl_cert_file={own}", f"ssl_key_file={own}"]
        command = ["setpriv", *become, "--pdeathsig", "QUIT", str(_BINARIES[-1] / "postgres")]
        command += ["-D", str(self._folder / "data")]
        command += [word for setting in settings for word in ("-c", setting)]
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, cwd="/")
        while subprocess.run(
            [str(_BINARIES[-1] / "pg_isready"), "-q", "-h", "127.0.0.1", "-p", self._port], check=False
        ).returncode:
            assert self._process.poll() is None, (self._folder / "log").read_text()
            time.sleep(0.05)

    def stop(self) -> None:
        """Stop it at once, as a crash does; what was committed stays."""
        self._process.send_signal(signal.SIGQUIT)
        self._process.wait(timeout=60)

    def database(self, *options: str) -> str:
        """The URL of a new database. options: of createdb."""
        self._count += 1
        self._run("createdb", *options, "-h", "127.0.0.1", "-p", self._port, "-U", "fleet", f"d{self._count}")
        return f"postgresql://fleet@127.0.0.1:{self._port}/d{self._count}"

    def _run(self, program: str, *words: str) -> None:
        command = [str(_BINARIES[-1] / program), *words]
        subprocess.run(command, check=True, capture_output=True, cwd="/", timeout=120, **self._account)


@contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """Skips where the package is missing."""
    if not _BINARIES:
        pytest.skip("NO POSTGRESQL: a database on a server is not tested; apt-get install postgresql to do it")
    with tempfile.TemporaryDirectory(prefix="postgres-") as folder:
        server = PostgresServer(Path(folder))
        try:
            yield server
        finally:
            server.stop()
