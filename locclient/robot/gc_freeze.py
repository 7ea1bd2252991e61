"""Garbage collection that leaves alone what was there before a drive."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def gc_frozen() -> Iterator[None]:
    """Exempts present objects from garbage collection while it lasts: libraries hold some hundred thousand that are never dropped,
    and now and then a frame would have to wait until all of them were traversed."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
