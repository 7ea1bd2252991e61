"""Options of numba, in this one place: cached, without the GIL, and without fast-math so that bits repeat."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """`function` compiled on first call. Division by zero gives inf or NaN, as in numpy."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def inline_kernel(function: F) -> F:
    """As `kernel`, inlined into its callers: for the few-line helpers of inner loops."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")(function))


def inner_kernel(function: F) -> F:
    """As `kernel`, inlined by LLVM: for larger helpers of inner loops, which numba's own inlining would make slow to compile."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)(function))
