"""Options of numba, in this one place: cached, without the GIL, and without fast-math so that bits repeat."""

import atexit
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from fleetmap.errors import FleetmapError

F = TypeVar("F", bound=Callable[..., object])

_config: Any = numba.config  # without types
KERNELS: list[Any] = []  # numba's dispatchers of all kernels that were imported


def kernel(function: F) -> F:
    """`function` compiled on first call. Division by zero gives inf or NaN, as in numpy."""
    return _cached(function)


def inline_kernel(function: F) -> F:
    """As `kernel`, inlined into its callers: for the few-line helpers of inner loops."""
    return _cached(function, inline="always")


def inner_kernel(function: F) -> F:
    """As `kernel`, inlined by LLVM: for larger helpers of inner loops, which numba's own inlining would make slow to compile."""
    return _cached(function, forceinline=True)


def uncounted_kernel(function: F) -> F:
    """As `kernel`, for one that allocates nothing: references to arrays are not counted on the way through its helpers.

    numba counts each array of a tuple each time that it is handed on, by an atomic operation that no optimisation removes.
    """
    return _cached(function, _nrt=False)


def uncounted_inner_kernel(function: F) -> F:
    """As `inner_kernel`, for helpers of an `uncounted_kernel`."""
    return _cached(function, forceinline=True, _nrt=False)


def _cached(function: F, **options: Any) -> F:
    compile_it = numba.njit(cache=True, nogil=True, error_model="numpy", **options)
    try:
        try:
            compiled = compile_it(function)
        except RuntimeError:  # numba found no folder that it can write
            _move_cache()
            compiled = compile_it(function)
    except (RuntimeError, OSError) as error:
        asked = os.environ.get("NUMBA_CACHE_DIR") or "the user's cache"
        raise FleetmapError(
            f"compiled kernels can be kept neither in {asked} nor beside {function.__code__.co_filename}; "
            "set NUMBA_CACHE_DIR to a folder that this user may write"
        ) from error
    KERNELS.append(compiled)
    return cast(F, compiled)


def _move_cache() -> None:
    """Copies a set folder that cannot be written, for this process, to one that can: numba does not read the first."""
    before = Path(_config.CACHE_DIR)
    if not _config.CACHE_DIR or not before.is_dir():
        return
    places = (os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0], "/dev/shm")
    place = next((place for place in places if place and os.access(place, os.W_OK)), None)
    folder = tempfile.mkdtemp(prefix="fleetmap-kernels-", dir=place)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    with suppress(OSError):  # of what cannot be read; it is compiled again
        shutil.copytree(before, folder, dirs_exist_ok=True)
    warnings.warn(f"compiled kernels in {before} cannot be written; a copy in {folder} is used", stacklevel=2)
    os.environ["NUMBA_CACHE_DIR"] = _config.CACHE_DIR = folder
