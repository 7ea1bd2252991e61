"""What was freed goes back to the system."""

import ctypes
import mmap
from pathlib import Path

import numpy as np
import pytest

from fleetmap.free_memory import give_back_free_memory


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="the C library is not glibc")
def test_what_was_freed_below_something_that_is_in_use_is_given_back() -> None:
    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE / 2**20

    blocks = [
        np.ones(6_000) for _ in range(3_000)
    ]  # 137 MB in the heap, as they are too small for a mapping of their own
    last = blocks[-1]
    blocks.clear()
    held_mb = resident_mb()
    give_back_free_memory()
    assert resident_mb() < held_mb - 100
    assert last[0] == 1
