"""Return of unused memory to the system, and exemption of startup objects from garbage collection."""

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager


def give_back_free_memory() -> None:
    """Return memory cached by the C library to the system: a third of a long survey's peak. Does nothing without glibc."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


@contextmanager
def gc_frozen() -> Iterator[None]:
    """Exempt existing objects from garbage collection: libraries hold several hundred thousand permanent objects, whose traversal
    would delay a frame from time to time. What they left is given back first."""
    gc.collect()
    give_back_free_memory()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
