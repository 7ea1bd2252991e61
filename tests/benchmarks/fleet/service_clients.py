"""Simulated robots of `bench_service`: each with its own connection, many in one process. Run as a process of its own."""

import json
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from fleetmap.bus import TlsFiles, ZenohBus
from fleetmap.mapformat import Manifest, apply_patch, decode_manifest, sha256_hex, verified
from fleetmap.messages import WantedVersion, blob_key, decode_message, manifest_key, patch_key, robot_key
from locclient.maps.chunked_download import ChunkReader

SITE = "bench"
_TIMEOUT_S, _PATIENCE_S = 20.0, 120.0


def robot_name(process: int, number: int) -> str:
    """Of a robot among those of its process."""
    return f"robot-{1000 * process + number}"


@dataclass
class Shared:
    """What robots of one process need to have only once: the base of patches, and patches whose result was verified."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    bytes: dict[str, bytes] = field(default_factory=dict)
    good_patches: dict[tuple[str, str], str] = field(default_factory=dict)

    def check_patch(self, base: str, result: str, patch: bytes) -> None:
        """Every robot's patch is hashed; the first one is applied, and its result verified."""
        found = sha256_hex(patch)
        with self.lock:
            if (base, result) not in self.good_patches:
                self.bytes[result] = verified(apply_patch(self.bytes[base], patch), result)
                self.good_patches[base, result] = found
        assert self.good_patches[base, result] == found, "a patch was damaged on its way"


class Robot:
    """One client: its connection, its manifest, what it received."""

    def __init__(self, endpoint: str, name: str, shared: Shared, tls: TlsFiles | None) -> None:
        self._bus = ZenohBus.connect(endpoint, tls=tls)
        self._name, self._shared = name, shared
        self._parts = ChunkReader(self._bus, timeout_s=_TIMEOUT_S, patience_s=_PATIENCE_S)
        self._manifest: Manifest | None = None
        self._address = ""
        self.phases: list[dict[str, float]] = []

    def fetch(self) -> None:
        """The wanted version, every byte of it verified: whole at first, later as patches."""
        begun_s, begun_bytes = time.monotonic(), self._parts.received_bytes
        question = robot_key(SITE, self._name, "wanted")
        wanted = decode_message(self._bus.get(question, timeout_s=_PATIENCE_S), WantedVersion)
        assert wanted.manifest_sha256 is not None and wanted.version is not None
        old = self._manifest
        if old is None:
            data = self._whole(manifest_key(SITE, wanted.version), wanted.manifest_sha256, 1 << 24)
        else:
            data = self._patched(self._address, wanted.manifest_sha256)
        self._manifest, self._address = decode_manifest(data), wanted.manifest_sha256
        bases = {} if old is None else {(tile.x, tile.y): tile.sha256 for tile in old.tiles}
        if old is None:
            self._whole(blob_key(SITE, self._manifest.vocabulary.sha256), self._manifest.vocabulary.sha256, 1 << 24)
        for tile in self._manifest.tiles:
            base = bases.get((tile.x, tile.y))
            if base is None:
                self._whole(blob_key(SITE, tile.sha256), tile.sha256, tile.bytes)
            elif base != tile.sha256:
                self._patched(base, tile.sha256)
        received = self._parts.received_bytes - begun_bytes
        self.phases.append({"seconds": time.monotonic() - begun_s, "bytes": received})

    def forget(self) -> None:
        """As a robot with an empty disk."""
        self._manifest = None

    def close(self) -> None:
        self._bus.close()

    def _whole(self, key: str, sha256: str, max_bytes: int) -> bytes:
        data = verified(self._parts.read(key, max_bytes=max_bytes), sha256)
        with self._shared.lock:
            return self._shared.bytes.setdefault(sha256, data)

    def _patched(self, base: str, result: str) -> bytes:
        patch = self._parts.read(patch_key(SITE, base, result), max_bytes=1 << 24)
        self._shared.check_patch(base, result, patch)
        return self._shared.bytes[result]


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
    shared = Shared()
    names = [robot_name(process, number) for number in range(count)]
    identities = {name: TlsFiles(folder / "servers.ca", folder / f"{name}.pem") for folder in folders for name in names}
    robots = [Robot(endpoint, name, shared, identities.get(name)) for name in names]
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
