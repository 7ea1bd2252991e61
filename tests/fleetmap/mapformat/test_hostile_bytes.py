"""Map bytes from an attacker: never anything but the project's own errors, and little time and memory for the worst."""

import struct
import time
import tracemalloc

import numpy as np
import pytest

from fleetmap.mapformat.container import pack
from fleetmap.mapformat.tile_codec import MAX_TILE_PLACES, decode_tile

_LIMIT = 16 << 20


def steps_of_one(count: int) -> bytes:
    """`count` increasing ids as differences in planes."""
    return b"\1" * count + bytes(3 * count)


def fullest_tile(kind: str) -> bytes:
    """As much as the limits allow, in a few hundred bytes of zstd."""
    if kind == "landmarks":
        count = _LIMIT // 48 - 1
        return struct.pack("<iidiIII", 0, 0, 16.0, 0, count, 0, 0) + steps_of_one(count) + bytes(44 * count)
    places = MAX_TILE_PLACES
    each = (_LIMIT // 4 - 7 * places - 8) // places if kind == "references" else 0
    head = struct.pack("<iidiIII", 0, 0, 16.0, 0, 0, places, places * each)
    counts = np.full(places, each, "<u4").view(np.uint8).reshape(-1, 4).T.tobytes()
    return head + steps_of_one(places) + bytes(19 * places) + counts + steps_of_one(places * each)


@pytest.mark.parametrize("kind", ["landmarks", "places", "references"])
def test_the_fullest_tile_takes_little(kind: str) -> None:
    data = pack(b"FMTL", 2, fullest_tile(kind), level=1)
    assert len(data) < 2000
    started_s = time.process_time()
    decode_tile(data)
    assert time.process_time() - started_s < 3  # a tenth of it, measured


def test_the_fullest_tile_takes_little_memory() -> None:
    data = pack(b"FMTL", 2, fullest_tile("landmarks"), level=1)
    tracemalloc.start()
    decode_tile(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 * _LIMIT
