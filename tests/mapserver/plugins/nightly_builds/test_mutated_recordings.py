"""Mutated recordings of failures and drives: each is judged within 20 s of the processor and 512 MB.

MUTATED=10000 python -m pytest tests/mapserver/plugins/nightly_builds/test_mutated_recordings.py
"""

import os
import resource
import struct
import time
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import CompressionMode

from fleetmap.errors import FleetmapError
from fleetmap.recordings import OpenOptions
from mapserver.fleet.replay_judge import judged
from mapserver.plugins.nightly_builds.recordings import read
from support.fleet.failed_robot import small_file
from support.recordings.bag_samples import write_rosbag1, write_rosbag2
from support.recordings.mcap_samples import foreign_messages
from support.recordings.recording_samples import make_sample, write_euroc

COUNT = int(os.environ.get("MUTATED", "15"))
MOST_S, MOST_BYTES = 20.0, 512 << 20
SIZES = (0, 1, 255, 1 << 20, (1 << 26) - 1, 1 << 31, (1 << 63) - 1, (1 << 64) - 1)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Up to four changes: bytes, sizes, and parts that are cut off, left out, repeated or swapped."""
    for _ in range(rng.integers(1, 5)):
        first, last = sorted(rng.integers(0, len(data) + 1, 2).tolist())
        size = struct.pack("<Q", int(rng.choice(np.array(SIZES, np.uint64))))
        parts = (data[:first] + rng.bytes(1) + data[first + 1 :], data[:first] + size + data[first + 8 :], data[:last])
        data = (*parts, data[:first] + data[last:], data[:last] + data[first:])[rng.integers(5)] or b"x"
    return data


def whole(kind: str, folder: Path) -> Path:
    """A recording of this kind that can be read."""
    if kind == "euroc":
        return write_euroc(folder / "whole", make_sample(4))
    if kind == "mcap":
        small_file(folder / "whole.mcap")
    elif kind == "bag":
        write_rosbag1(folder / "whole.bag", foreign_messages(), Writer.CompressionFormat.LZ4)
    else:
        write_rosbag2(folder / "whole", foreign_messages(), CompressionMode.MESSAGE)
    return next(folder.rglob(f"*.{kind}"))


def judge_all(kind: str, folder: Path) -> None:
    path = whole(kind, folder)
    files = {file: file.read_bytes() for file in sorted([path, *path.rglob("*")]) if file.is_file()}
    assert read(path, OpenOptions())[0]
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        file = list(files)[rng.integers(len(files))]
        file.write_bytes(mutated(files[file], rng))
        begun_s = time.process_time()
        with suppress(FleetmapError, IsADirectoryError):
            judged(path, ("lab", "r1", "f1"))
        read(path, OpenOptions())
        assert time.process_time() - begun_s < MOST_S, seed
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 < MOST_BYTES, seed
        file.write_bytes(files[file])


@pytest.mark.timeout(36_000)
@pytest.mark.parametrize("kind", ["mcap", "db3", "bag", "euroc"])
def test_mutated_recordings_cost_little(tmp_path: Path, kind: str) -> None:
    with get_context("spawn").Pool(1) as pool:
        pool.apply(judge_all, (kind, tmp_path))
