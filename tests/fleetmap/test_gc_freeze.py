"""Garbage collection leaves alone what was there before a drive, and nothing else."""

import gc
import weakref

from fleetmap.free_memory import gc_frozen


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
