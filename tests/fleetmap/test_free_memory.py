"""Memory goes back to the system, and what was there before a drive is left alone by the garbage collection."""

import ctypes
import gc
import weakref

import numpy as np
import psutil
import pytest

from fleetmap.free_memory import gc_frozen, give_back_free_memory


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="the C library is not glibc")
def test_what_was_freed_below_something_that_is_in_use_is_given_back() -> None:
    memory = psutil.Process().memory_info
    # 137 MB in the heap, as they are too small for a mapping of their own
    blocks = [np.ones(6_000) for _ in range(3_000)]
    last = blocks[-1]
    blocks.clear()
    held_bytes = memory().rss
    give_back_free_memory()
    assert memory().rss < held_bytes - (100 << 20)
    assert last[0] == 1


class Ring:
    """Refers to itself: only the collector can end it."""

    def __init__(self) -> None:
        self.me = self


def test_what_lived_before_is_left_alone_and_what_comes_later_is_not() -> None:
    before = Ring()
    of_before = weakref.ref(before)
    with gc_frozen():
        del before
        of_later = weakref.ref(Ring())
        gc.collect()
        assert of_before() is not None
        assert of_later() is None
        assert gc.get_freeze_count() > 0
    gc.collect()
    assert of_before() is None
    assert gc.get_freeze_count() == 0
