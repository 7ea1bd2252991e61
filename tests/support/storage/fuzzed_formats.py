"""Damaged and hostile bytes of every format that comes from outside, made by hypothesis from whole ones."""

import hashlib
import resource
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fleetmap.errors import FleetmapError
from fleetmap.mapformat.container import pack, unpack
from fleetmap.mapformat.manifest import decode_manifest
from fleetmap.mapformat.tile import TILE_FORMAT, decode_tile
from fleetmap.mapformat.version_file import open_export
from fleetmap.version_grid import TILE_CELLS, decode_grid_tile, encode_grid
from mapserver.store.archive import ARCHIVE_FORMAT, decode_archive

GOLDEN = Path(__file__).parents[2] / "golden"
MAX_CPU_SECONDS = 2.0
MAX_GROWTH_BYTES = 256 << 20
_NUMBERS = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, (1 << 63) - 1, (1 << 64) - 1]

Edit = tuple[float, int | None, bytes | int]
"""Position (as a share), how many bytes go (None: as many as come), what comes: bytes, or those there so many times."""

_coming = st.one_of(
    st.binary(max_size=64),
    st.builds(
        lambda n, size: (n % (1 << (8 * size))).to_bytes(size, "little"),
        st.sampled_from(_NUMBERS),
        st.sampled_from([1, 2, 4, 8]),
    ),
    st.integers(1, 300),
)
edits = st.lists(
    st.tuples(st.floats(0, 1), st.sampled_from([None, 0]) | st.integers(1, 4096), _coming), min_size=1, max_size=6
)
_json_values = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.floats(),
        st.integers(-(1 << 70), 1 << 70),
        st.text(max_size=20),
        st.just("ab" * 32),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=8), inner, max_size=4)),
    max_leaves=8,
)


def edited(data: bytes, changes: list[Edit]) -> bytes:
    """`data` with the edits, one after the other."""
    for share, going, coming in changes:
        at = int(share * max(0, len(data) - 1))
        new = data[at : at + 16] * coming if isinstance(coming, int) else coming
        data = data[:at] + new + data[at + (len(new) if going is None else going) :]
    return data


def edited_json(data: bytes, changes: list[tuple[int, Any]]) -> bytes:
    """A JSON document in which some values, counted through the whole tree, are others."""
    document = msgspec.json.decode(data)
    for number, value in changes:
        places: list[tuple[Any, Any]] = []
        _collect(document, places)
        if places:
            holder, key = places[number % len(places)]
            holder[key] = value
    try:
        return msgspec.json.encode(document)
    except (TypeError, ValueError, OverflowError, UnicodeEncodeError):
        return b"{}"


def _collect(value: Any, places: list[tuple[Any, Any]]) -> None:
    keys = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in list(keys):
        places.append((value, key))
        _collect(value[key], places)


json_edits = st.lists(st.tuples(st.integers(0, 1000), _json_values), min_size=1, max_size=3)


def manifests() -> st.SearchStrategy[bytes]:
    """Manifests, with damaged bytes or with other values."""
    whole = (GOLDEN / "manifest-1.json").read_bytes()
    return st.one_of(
        edits.map(lambda changes: edited(whole, changes)),
        json_edits.map(lambda changes: edited_json(whole, changes)),
        st.binary(max_size=200),
        st.integers(1, 20_000).map(lambda depth: b'{"a":' * depth),
        st.integers(1, 20_000).map(lambda depth: b"[" * depth),
    )


def _enveloped(file: str, magic: bytes, number: int) -> st.SearchStrategy[bytes]:
    """Binary files, damaged outside, and damaged inside of a sound envelope."""
    whole = (GOLDEN / file).read_bytes()
    payload = unpack(magic, number, whole, file, 1 << 30)
    # Small outside, large inside.
    swollen = [pack(magic, number, bytes(1 << bits), level=1) for bits in (20, 24, 26)]
    return st.one_of(
        edits.map(lambda changes: edited(whole, changes)),
        *[edits.map(lambda changes: pack(magic, number, edited(payload, changes), level=1))] * 2,
        st.tuples(st.sampled_from(swollen), st.integers(0, 19)).map(
            lambda pick: pick[0] if pick[1] == 0 else whole[pick[1] :]
        ),
        st.binary(max_size=100).map(lambda rest: magic + rest),
    )


def exports() -> st.SearchStrategy[bytes]:
    """Export files, damaged, and damaged with a right sum at their end."""
    body = (GOLDEN / "version-3.fmex").read_bytes()[:-32]
    head_bytes = int.from_bytes(body[8:12], "little")

    def summed(data: bytes) -> bytes:
        return data + hashlib.sha256(data).digest()

    def other_head(changes: list[tuple[int, Any]]) -> bytes:
        head = edited_json(body[12 : 12 + head_bytes], changes)
        return summed(body[:8] + len(head).to_bytes(4, "little") + head + body[12 + head_bytes :])

    return st.one_of(
        edits.map(lambda changes: edited(body, changes)),
        edits.map(lambda changes: summed(edited(body, changes))),
        json_edits.map(other_head),
    )


def grid_tiles() -> st.SearchStrategy[bytes]:
    """Tiles of the grid that the store keeps."""
    cells = np.resize(np.arange(256, dtype=np.uint8), (TILE_CELLS, TILE_CELLS, 4))
    whole = encode_grid({(1, -2): cells})[1]
    return edits.map(lambda changes: edited(whole, changes))


def read_export(data: bytes, folder: Path) -> None:
    """All checks that an import makes before it believes a file."""
    path = folder / "fuzzed.fmex"
    path.write_bytes(data)
    with open_export(path) as reader:
        reader.check_whole()
        reader.check_tiles(reader.manifest())


FORMATS: dict[str, tuple[Callable[[], st.SearchStrategy[bytes]], Callable[[bytes, Path], object]]] = {
    "manifest": (manifests, lambda data, _: decode_manifest(data)),
    "tile": (partial(_enveloped, "tile-2.fmtl", b"FMTL", TILE_FORMAT), lambda data, _: decode_tile(data)),
    "archive": (partial(_enveloped, "archive-2.fmar", b"FMAR", ARCHIVE_FORMAT), lambda data, _: decode_archive(data)),
    "export": (exports, read_export),
    "grid tile": (grid_tiles, lambda data, _: decode_grid_tile(data)),
}


def fuzz(name: str, count: int, folder: Path) -> dict[str, float]:
    """Reads `count` inputs of a format: each is read or refused by a FleetmapError, soon, and without much memory.

    Returns how many were refused, the slowest (CPU seconds), and by how much the process's memory grew at most.
    """
    strategy, read = FORMATS[name]
    found: dict[str, float] = {"inputs": 0, "refused": 0, "slowest_s": 0.0}
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    @settings(max_examples=count, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    @given(data=strategy())
    def one(data: bytes) -> None:
        found["inputs"] += 1
        begun_s = time.process_time()
        try:
            read(data, folder)
        except FleetmapError:
            found["refused"] += 1
        found["slowest_s"] = max(found["slowest_s"], time.process_time() - begun_s)

    one()
    found["growth_mb"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb) / 1024
    assert found["slowest_s"] < MAX_CPU_SECONDS, found
    assert found["growth_mb"] * (1 << 20) < MAX_GROWTH_BYTES, found
    return found
