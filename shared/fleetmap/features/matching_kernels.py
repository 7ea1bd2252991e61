"""Inner loops of binary descriptor matching. Descriptors are (N, 4) uint64: 256 bits."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from fleetmap.numerics.kernel import inner_kernel

Packed = NDArray[np.uint64]
Indices = NDArray[np.int64]
Distances = NDArray[np.int32]
FAR = 257  # more than any two descriptors can differ by


def _popcount64(typing_context: Any, value: Any) -> Any:
    """The processor's population count, which numpy code inside numba has no name for."""
    return types.int64(types.uint64), lambda context, builder, signature, arguments: builder.ctpop(arguments[0])


popcount64 = cast(Callable[[np.uint64], int], intrinsic(_popcount64))


@inner_kernel
def hamming(a: Packed, i: int, b: Packed, j: int) -> int:
    """Number of bits in which row i of a and row j of b differ."""
    return (
        popcount64(a[i, 0] ^ b[j, 0])
        + popcount64(a[i, 1] ^ b[j, 1])
        + popcount64(a[i, 2] ^ b[j, 2])
        + popcount64(a[i, 3] ^ b[j, 3])
    )
