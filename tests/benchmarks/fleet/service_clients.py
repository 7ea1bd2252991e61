"""Simulated robots of `bench_service`: each with its own connection, many in one process. Run as a process of its own."""

import json
import sys
import threading
import time
from pathlib import Path

from fleetmap.bus import Bus, TlsFiles
from fleetmap.mapformat import Manifest, decode_manifest, verified
from fleetmap.messages import WantedVersion, blob_key, decode_message, manifest_key, robot_key
from locclient.maps.chunked_download import ChunkReader

SITE = "bench"
_TIMEOUT_S, _PATIENCE_S = 20.0, 120.0


def robot_name(process: int, number: int) -> str:
    """Of a robot among those of its process."""
    return f"robot-{1000 * process + number}"


class Robot:
    """One client: its connection, its manifest, what it received."""

    def __init__(self, endpoint: str, name: str, tls: TlsFiles | None) -> None:
        self._bus = Bus.connect(endpoint, tls=tls)
        self._name = name
        self._parts = ChunkReader(self._bus, timeout_s=_TIMEOUT_S, patience_s=_PATIENCE_S)
        self._manifest: Manifest | None = None
        self.phases: list[dict[str, float]] = []

    def fetch(self) -> None:
        """The wanted version, every byte of it verified: all at first, later the tiles that changed."""
        begun_s, begun_bytes = time.monotonic(), self._parts.received_bytes
        question = robot_key(SITE, self._name, "wanted")
        wanted = decode_message(self._bus.get(question, timeout_s=_PATIENCE_S), WantedVersion)
        assert wanted.manifest_sha256 is not None and wanted.version is not None
        data = self._whole(manifest_key(SITE, wanted.version), wanted.manifest_sha256, 1 << 24)
        old, new = self._manifest, decode_manifest(data)
        self._manifest = new
        known = set() if old is None else {old.vocabulary.sha256, *(tile.sha256 for tile in old.tiles)}
        words = (new.vocabulary.sha256, new.vocabulary.bytes)
        for sha256, size in (words, *((tile.sha256, tile.bytes) for tile in new.tiles)):
            if sha256 not in known:
                self._whole(blob_key(SITE, sha256), sha256, size)
        received = self._parts.received_bytes - begun_bytes
        self.phases.append({"seconds": time.monotonic() - begun_s, "bytes": received})

    def forget(self) -> None:
        """As a robot with an empty disk."""
        self._manifest = None

    def close(self) -> None:
        self._bus.close()

    def _whole(self, key: str, sha256: str, max_bytes: int) -> bytes:
        return verified(self._parts.read(key, max_bytes=max_bytes), sha256)


def together(robots: list[Robot]) -> None:
    """All of them at once; raises the first failure."""
    failures: list[BaseException] = []

    def run(robot: Robot) -> None:
        try:
            robot.fetch()
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=run, args=(robot,)) for robot in robots]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]


def main() -> None:
    """ENDPOINT PROCESS COUNT [FOLDER of certificates]: fetches once for every line on stdin, answers each with a line of JSON."""
    endpoint, process, count, *folders = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), *map(Path, sys.argv[4:])
    names = [robot_name(process, number) for number in range(count)]
    identities = {name: TlsFiles(folder / "servers.ca", folder / f"{name}.pem") for folder in folders for name in names}
    robots = [Robot(endpoint, name, identities.get(name)) for name in names]
    print("ready", flush=True)
    for line in sys.stdin:
        if line.strip() == "anew":
            for robot in robots:
                robot.forget()
        together(robots)
        print(json.dumps([robot.phases[-1] for robot in robots]), flush=True)
    for robot in robots:
        robot.close()


if __name__ == "__main__":
    main()
