"""Plays recordings of failures with arbitrary arrays; prints how many were played and how many refused.

    python arbitrary_failures.py FAILURE.mcap STORE

Under `make sanitize` a step of the core that reads beside an array ends it.
"""

import copy
import sys
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fleetmap.errors import FleetmapError
from fleetmap.failure_summary import decode_summary
from fleetmap.recordings.failure_recording import LOCALIZER, SUMMARY, attachments_of
from locclient.delivery.failure_file import decode_record
from locclient.maps.map_source import LocalMapSource
from locclient.replay.failure_replay import compare_failure

FRAMES = 6
DTYPES = ("<f8", "<f4", "<i8", "<u8", "<u4", "|u1", "|i1", "|b1")
NUMBERS = st.sampled_from([0, 1, -1, 31, 127, -128, 255, 640, 1e9, -1e9, 1e300, float("nan"), float("inf")])
counts = {"played": 0, "refused": 0}


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Any:
    """Paths of all arrays and numbers."""
    is_array = isinstance(value, list) and len(value) == 3 and isinstance(value[2], bytes)
    if is_array or not isinstance(value, dict | list):
        yield path
    else:
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from leaves(value[key], (*path, key))


def spoiled(draw: st.DrawFn, value: Any) -> Any:
    """Another value in the place of one."""
    number = draw(NUMBERS)
    if not isinstance(value, list):
        return draw(
            st.sampled_from([None, int(number) if abs(number) < 1e10 else 1 << 61, float(number), "", [], True])
        )
    form, shape, data = value
    kind = draw(st.sampled_from(["one value", "another length", "another kind", "another shape"]))
    stored = "<f4" if form == "<f8" and len(data) == 4 * int(np.prod(shape)) else form
    array = np.frombuffer(data, stored).reshape(shape).copy()
    with np.errstate(all="ignore"):
        if kind == "one value" and array.size:
            array.flat[draw(st.integers(0, array.size - 1))] = np.asarray(number).astype(array.dtype)
        elif kind == "another length" and array.ndim:
            array = np.resize(array, (draw(st.sampled_from([0, 1, 7, 9_999, 10_001])), *array.shape[1:]))
        elif kind == "another kind":
            array = np.nan_to_num(array.astype(float)).astype(draw(st.sampled_from(DTYPES)))
        elif kind == "another shape":
            array = array.reshape(-1) if draw(st.booleans()) else array.T
    return [array.dtype.str, list(array.shape), array.tobytes()]


def main(failure: Path, store: Path) -> None:
    """Plays what was written as it is, and then with arbitrary values."""
    attachments = attachments_of(failure)
    summary = decode_summary(attachments[SUMMARY])
    summary = msgspec.structs.replace(summary, moments=summary.moments[:FRAMES])
    unpacked = zstandard.ZstdDecompressor().decompress(attachments[LOCALIZER], max_output_size=64 << 20)
    state = msgspec.msgpack.decode(unpacked, strict=False)
    state["frames"] = state["frames"][:FRAMES]
    paths, source = list(leaves(state)), LocalMapSource(store, summary.site)
    by_name: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
    for path in paths:
        by_name.setdefault(tuple("*" if isinstance(key, int) else key for key in path), []).append(path)

    def play(changed: Any) -> None:
        try:
            record = decode_record(msgspec.msgpack.encode(changed), summary)
            compare_failure((summary, record), source)
            counts["played"] += 1
        except FleetmapError:
            counts["refused"] += 1

    play(state)
    assert counts["played"] == 1

    @settings(max_examples=80, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def arbitrary(data: st.DataObject) -> None:
        changed = copy.deepcopy(state)
        path = data.draw(st.sampled_from(data.draw(st.sampled_from(list(by_name.values())))))
        reduce(getitem, path[:-1], changed)[path[-1]] = data.draw(
            st.composite(lambda draw: spoiled(draw, reduce(getitem, path, changed)))()
        )
        play(changed)

    arbitrary()
    print(counts["played"], counts["refused"])


main(Path(sys.argv[1]), Path(sys.argv[2]))
