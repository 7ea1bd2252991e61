"""Exemption of startup objects from garbage collection."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def gc_frozen() -> Iterator[None]:
    """Exempt existing objects from garbage collection: libraries hold several hundred thousand permanent objects, whose traversal
    would delay a frame from time to time."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
