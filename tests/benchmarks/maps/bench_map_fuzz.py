"""Damaged and hostile map bytes in great number: refused or read, never a crash, a hang, or memory without bound.

    PYTHONPATH=tests python tests/benchmarks/maps/bench_map_fuzz.py [--inputs 100000] [--seed 0] [--out FILE.json]

Inputs are made of real ones of each kind (tiles of both formats, manifests): bytes flipped, cut, doubled and
swapped in the file as it travels, where checksums find nearly all of it; and in the payload before it is packed, as an attacker
would, where only the decoder's own checks stand. Every input is decoded in this process; the slowest and the most memory are reported.
"""

import argparse
import json
import os
import platform
import resource
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fleetmap.errors import FleetmapError
from fleetmap.mapformat import (
    BlobEntry,
    CameraEntry,
    Manifest,
    TileEntry,
    decode_manifest,
    decode_tile,
    encode_manifest,
    encode_tile,
    pack,
    sha256_hex,
    unpack,
)
from support.storage.map_samples import random_tile

_LIMIT = 16 << 20
_INTERESTING = (0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)

Maker = Callable[[np.random.Generator], bytes]
Reader = Callable[[bytes], object]


def damaged(rng: np.random.Generator, data: bytes) -> bytes:
    """One to four random damages."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        if not out:
            return bytes(out)
        at = int(rng.integers(len(out)))
        kind = int(rng.integers(6))
        if kind == 0:
            out[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            out[at] = int(rng.integers(256))
        elif kind == 2:
            del out[at:]
        elif kind == 3:
            out[at:at] = out[max(0, at - int(rng.integers(1, 64))) : at]
        elif kind == 4:
            del out[at : at + int(rng.integers(1, 64))]
        else:
            word = struct.pack("<I", _INTERESTING[int(rng.integers(len(_INTERESTING)))])
            out[at : at + 4] = word[: len(out) - at]
    return bytes(out)


def head_damaged(rng: np.random.Generator, data: bytes, size: int) -> bytes:
    """As `damaged`, mostly within the first `size` bytes, where counts and sizes stand."""
    if rng.random() < 0.5:
        return damaged(rng, data)
    return damaged(rng, data[:size]) + data[size:]


def manifest(count: int) -> bytes:
    tiles = tuple(TileEntry(x=n, y=-n, sha256=sha256_hex(bytes([n])), bytes=100 + n, landmarks=n) for n in range(count))
    return encode_manifest(
        Manifest(
            site="lab", version=3, parent=2, created="2026-01-02T03:04:05Z", tile_size_m=16.0, tiles=tiles,
            vocabulary=BlobEntry(sha256="a" * 64, bytes=9), configuration={"a": [1, {"b": None}]},
            camera=CameraEntry(focal_px=450.0, width_px=752, height_px=480, baseline_m=0.11),
        )
    )  # fmt: skip


def sources() -> dict[str, tuple[Maker, Reader]]:
    """For each kind of input how it is made and read."""
    rng = np.random.default_rng(0)
    whole = encode_tile(random_tile(rng, landmarks=60, places=4))
    payload = unpack(b"FMTL", 2, whole, "tile", _LIMIT)[1]
    text = manifest(5)
    empty = encode_tile(random_tile(rng, landmarks=0, places=0))

    def hostile_tile(rng: np.random.Generator) -> bytes:
        return pack(b"FMTL", int(rng.integers(1, 3)), head_damaged(rng, payload, 32), level=1)

    def noise(rng: np.random.Generator) -> bytes:
        magic = (b"FMTL", b"")[int(rng.integers(2))]
        return magic + rng.bytes(int(rng.integers(200)))

    return {
        "tile, damaged": (lambda rng: damaged(rng, whole), decode_tile),
        "empty tile, damaged": (lambda rng: damaged(rng, empty), decode_tile),
        "tile, hostile payload": (hostile_tile, decode_tile),
        "manifest, damaged": (lambda rng: damaged(rng, text), decode_manifest),
        "noise as tile": (noise, decode_tile),
        "noise as manifest": (noise, decode_manifest),
    }


def fuzz(inputs: int, seed: int) -> dict[str, dict[str, float]]:
    """Counts and the slowest input of each kind; an error that is not the project's own ends it, with its input's seed."""
    found: dict[str, dict[str, float]] = {}
    kinds = sources()
    for name, (make, read) in kinds.items():
        counts: Counter[str] = Counter()
        slowest_s, total_s = 0.0, 0.0
        for number in range(-(-inputs // len(kinds))):
            data = make(np.random.default_rng([seed, number]))
            begun_s = time.perf_counter()
            try:
                read(data)
                counts["read"] += 1
            except FleetmapError:
                counts["refused"] += 1
            except Exception as error:
                raise AssertionError(f"{name}, input {number} of seed {seed}: {error!r}") from error
            spent_s = time.perf_counter() - begun_s
            slowest_s, total_s = max(slowest_s, spent_s), total_s + spent_s
        found[name] = {
            "inputs": sum(counts.values()), "read": counts["read"], "refused": counts["refused"],
            "slowest_ms": 1e3 * slowest_s, "mean_ms": 1e3 * total_s / max(1, sum(counts.values())),
        }  # fmt: skip
    return found


def peak_mb() -> float:
    """The most memory that this process held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def show(found: dict[str, dict[str, float]]) -> None:
    """One line for each kind."""
    for name, figures in found.items():
        print(f"{name:34s} " + "  ".join(f"{key} {value:9.4g}" for key, value in figures.items()), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    before_mb = peak_mb()
    found = fuzz(options.inputs, options.seed)
    show(found)
    print(f"peak memory {before_mb:.0f} MB before, {peak_mb():.0f} MB after")
    if options.out is not None:
        about = {"machine": platform.machine(), "cores": os.cpu_count(), "command": sys.argv, "peak_mb": peak_mb()}
        options.out.write_text(
            json.dumps(about | {"kinds": found, "memory_mb": peak_mb() - before_mb}, indent=2) + "\n"
        )


if __name__ == "__main__":
    main()
