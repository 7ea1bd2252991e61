"""rclone's S3 server on this machine, and a store's content as somebody else changes it, in files or in objects."""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fleetmap.mapformat.names import blob_path
from mapserver.store import MapStore

KEYS = {"AWS_ACCESS_KEY_ID": "accesskey", "AWS_SECRET_ACCESS_KEY": "secretkey", "AWS_REGION": "us-east-1"}


@contextmanager
def s3_server(folder: Path) -> Iterator[str]:
    """The server's address; its bucket is named fleet."""
    (folder / "fleet").mkdir()
    (folder / "config").touch()
    key = f"{KEYS['AWS_ACCESS_KEY_ID']},{KEYS['AWS_SECRET_ACCESS_KEY']}"
    command = [str(Path(sys.executable).with_name("rclone")), "serve", "s3", str(folder), "--addr", "127.0.0.1:0"]
    command += ["--auth-key", key, "--config", str(folder / "config")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        yield next(filter(None, (re.search(r"http://[^/\]]+", line) for line in process.stderr)))[0]
    finally:
        process.terminate()
        process.wait(timeout=30)
        process.stderr.close()


class Content:
    """What lies under the addresses of a store, beside the store's own methods."""

    def __init__(self, store: MapStore) -> None:
        self._objects = store._blobs._objects

    def write(self, sha256: str, data: bytes) -> None:
        self._objects.put(blob_path(sha256), [data])

    def remove(self, sha256: str) -> None:
        self._objects.remove(blob_path(sha256))

    def count(self) -> int:
        return sum(1 for _ in self._objects.listed("blobs"))
