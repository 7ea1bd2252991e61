"""Mutated recordings of failures and drives: each is judged within 20 s of the processor and 512 MB.

MUTATED=10000 python -m pytest tests/mapserver/fleet/test_mutated_recordings.py
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

from fleetmap.errors import FleetmapError
from fleetmap.recordings import OpenOptions
from mapserver.fleet.replay_judge import judged
from mapserver.nightly.inbox import identify
from support.fleet.failed_robot import small_file

COUNT = int(os.environ.get("MUTATED", "60"))
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


def judge_all(folder: Path) -> None:
    whole, path = small_file(folder / "whole.mcap"), folder / "failure.mcap"
    for seed in range(COUNT):
        path.write_bytes(mutated(whole, np.random.default_rng(seed)))
        begun_s = time.process_time()
        with suppress(FleetmapError):
            judged(path, ("lab", "r1", "f1"))
        identify(path, OpenOptions())
        assert time.process_time() - begun_s < MOST_S, seed
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 < MOST_BYTES, seed


@pytest.mark.timeout(36_000)
def test_mutated_recordings_cost_little(tmp_path: Path) -> None:
    with get_context("spawn").Pool(1) as pool:
        pool.apply(judge_all, (tmp_path,))
