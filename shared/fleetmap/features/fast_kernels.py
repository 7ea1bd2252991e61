"""FAST corners as arrays, 32 pixels at a time. Source: Rosten and Drummond 2006, with nine pixels of sixteen and their score."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import popcount64
from fleetmap.numerics.kernel import kernel

Grey = NDArray[np.uint8]

LANES = 32
RADIUS_PX = 3
_CIRCLE = (
    (0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3),
    (0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3),
)  # fmt: skip


def _scores_at(typing_context: Any, pixel: Any, row_bytes: Any, score: Any, threshold: Any) -> Any:
    """Scores of the pixels from address `pixel` on, written to address `score`, 0 for no corner; a bit for each corner.

    The score is the smallest difference of the centre to nine pixels in a row of the circle, where that is largest: a corner's exceeds
    the threshold. numba has no name for a vector, and LLVM makes none of a loop over so many rows.
    """
    return types.uint64(types.int64, types.int64, types.int64, types.int64), _emit_scores


def _emit_scores(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    pixel, row_bytes, score, threshold = arguments
    lane, word = ir.VectorType(ir.IntType(8), LANES), ir.IntType(64)

    def grey(u: int, v: int) -> Any:
        row = builder.add(pixel, builder.mul(row_bytes, word(v)))
        return builder.load(builder.inttoptr(builder.add(row, word(u)), lane.as_pointer()), align=1)

    def lower(a: Any, b: Any) -> Any:
        return builder.select(builder.icmp_unsigned("<", a, b), a, b)

    def higher(a: Any, b: Any) -> Any:
        return builder.select(builder.icmp_unsigned(">", a, b), a, b)

    def less(a: Any, b: Any) -> Any:
        return builder.select(builder.icmp_unsigned(">", a, b), builder.sub(a, b), lane(None))

    def best_arc(circle: list[Any], worst: Callable[[Any, Any], Any], best: Callable[[Any, Any], Any]) -> Any:
        """Of the worst of nine in a row, the best; two rows of nine share eight."""
        twos = [worst(circle[k + 1], circle[(k + 2) % 16]) for k in range(0, 16, 2)]
        fours = [worst(twos[k], twos[(k + 1) % 8]) for k in range(8)]
        eights = [worst(fours[k], fours[(k + 2) % 8]) for k in range(8)]
        nines = [worst(eights[k], best(circle[2 * k], circle[(2 * k + 9) % 16])) for k in range(8)]
        while len(nines) > 1:
            nines = [best(a, b) for a, b in zip(nines[::2], nines[1::2], strict=True)]
        return nines[0]

    circle, centre = [grey(u, v) for u, v in _CIRCLE], grey(0, 0)
    brighter, darker = less(best_arc(circle, lower, higher), centre), less(centre, best_arc(circle, higher, lower))
    found = higher(brighter, darker)
    first = builder.insert_element(lane(ir.Undefined), builder.trunc(threshold, ir.IntType(8)), ir.IntType(32)(0))
    limit = builder.shuffle_vector(first, lane(ir.Undefined), ir.VectorType(ir.IntType(32), LANES)([0] * LANES))
    is_corner = builder.icmp_unsigned(">", found, limit)
    builder.store(builder.select(is_corner, found, lane(None)), builder.inttoptr(score, lane.as_pointer()), align=1)
    return builder.zext(builder.bitcast(is_corner, ir.IntType(LANES)), word)


_scores_of = cast(Callable[[int, int, int, int], int], intrinsic(_scores_at))


@kernel
def fast_corners(image: Grey, width: int, threshold: int, border_px: int, free: Grey) -> NDArray[np.float32]:
    """(N, 2) whole-pixel corners, row by row, whose score exceeds that of all eight neighbours.

    None nearer than border_px, at least RADIUS_PX, to an edge, or where free (H, width) is 0; free (0, 0): all is. image (H, W) without
    gaps between its rows, at least LANES + 2 RADIUS_PX wide; what is beyond `width` is no part of it.
    """
    height, row_bytes = image.shape
    last = row_bytes - RADIUS_PX - LANES
    blocks = 1 + (last - RADIUS_PX + LANES - 1) // LANES
    scores, corners = np.zeros((height, row_bytes), np.uint8), np.zeros((height, blocks), np.uint64)
    image_at, scores_at = np.int64(image.ctypes.data), np.int64(scores.ctypes.data)
    count = 0
    for y in range(max(border_px - 1, RADIUS_PX), min(height - border_px + 1, height - RADIUS_PX)):
        for block in range(blocks):
            x = RADIUS_PX + block * LANES
            begin = min(x, last)  # the last block overlaps the one before: what that held is not counted again
            at = y * row_bytes + begin
            bits = _scores_of(image_at + at, row_bytes, scores_at + at, threshold) >> np.uint64(x - begin)
            corners[y, block] = bits
            count += popcount64(bits)
        scores[y, width - RADIUS_PX :] = 0
    pixels = np.empty((count, 2), np.float32)
    found, one = 0, np.uint64(1)
    for y in range(border_px, height - border_px):
        above, here, below = scores[y - 1], scores[y], scores[y + 1]
        for block in range(blocks):
            bits = corners[y, block]
            while bits != np.uint64(0):
                x = RADIUS_PX + block * LANES + popcount64((bits & (~bits + one)) - one)
                bits &= bits - one
                if x < border_px or x >= width - border_px or (len(free) > 0 and free[y, x] == 0):
                    continue
                s = here[x]
                if (
                    s > here[x - 1] and s > here[x + 1]
                    and s > above[x - 1] and s > above[x] and s > above[x + 1]
                    and s > below[x - 1] and s > below[x] and s > below[x + 1]
                ):  # fmt: skip
                    pixels[found, 0], pixels[found, 1] = x, y
                    found += 1
    return pixels[:found].copy()
