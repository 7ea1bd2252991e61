"""A grid as bytes: the same again, deltas, and what is damaged is told."""

from functools import partial

import msgspec
import numpy as np
import pytest

from fleetmap import version_grid
from fleetmap.errors import MapFormatError, NewerFormatError, StateError
from fleetmap.mapformat.manifest import BlobEntry, Manifest
from fleetmap.mapformat.names import sha256_hex
from mapserver.tiles import tiling
from support.storage.map_samples import draft_details


def random_grid() -> version_grid.Tiles:
    rng, shape = np.random.default_rng(5), (version_grid.TILE_CELLS, version_grid.TILE_CELLS, 4)
    return {place: rng.integers(0, 256, shape, np.uint8) for place in ((-1, 2), (0, 0))}


def manifest_with(report: dict[str, object]) -> Manifest:
    details = draft_details(**report)
    fields = {name: getattr(details, name) for name in details.__struct_fields__}
    return Manifest(site="lab", version=3, tiles=(), vocabulary=BlobEntry(sha256="ab" * 32, bytes=3), **fields)


def test_bytes_and_back_and_only_what_changed_is_new() -> None:
    tiles = random_grid()
    blobs = version_grid.encode_grid(tiles)
    kept = {sha256_hex(data): data for data in blobs}
    manifest = manifest_with({"grid": msgspec.to_builtins(version_grid.grid_report(blobs, {}))})
    found = version_grid.grid_of(manifest, kept.__getitem__)
    np.testing.assert_equal(found, tiles)
    assert list(found) == sorted(tiles)
    assert version_grid.encode_grid(found) == blobs
    changed = version_grid.encode_grid(tiles | {(0, 0): tiles[0, 0] ^ 1})
    assert len(set(changed) - set(blobs)) == 2  # the index and one tile


def test_its_tiles_are_squares_of_the_maps() -> None:
    assert version_grid.TILE_SIZE_M == tiling.TILE_SIZE_M


def test_a_version_without_a_grid_says_why() -> None:
    with pytest.raises(StateError, match="occupancy_grid = true"):
        version_grid.grid_of(manifest_with({}), {}.__getitem__)
    assert version_grid.known_grid(manifest_with({}), {}.__getitem__) == {}
    said = msgspec.to_builtins(version_grid.grid_report([], {"walk": "one camera measures no depth"}))
    with pytest.raises(StateError, match="walk: one camera measures no depth"):
        version_grid.grid_of(manifest_with({"grid": said}), {}.__getitem__)
    with pytest.raises(MapFormatError, match=r"report\.grid"):
        version_grid.grid_of(manifest_with({"grid": {"sha256": "x"}}), {}.__getitem__)


def test_damaged_bytes_are_told() -> None:
    index, tile, _ = version_grid.encode_grid(random_grid())
    for data in (tile[:-1], tile[:40], b"", b"FMTL" + tile[4:]):
        with pytest.raises(MapFormatError):
            version_grid.decode_grid_tile(data)
    with pytest.raises(NewerFormatError):
        version_grid.decode_grid_tile(tile[:4] + b"\x02\x00" + tile[6:])
    read_index = partial(version_grid.decode_index, kind=version_grid.GridIndex, what="a grid", tiles=())
    with pytest.raises(MapFormatError):
        read_index(index[:-1])
    with pytest.raises(NewerFormatError, match="format 2"):
        read_index(index.replace(b'"format_version":1', b'"format_version":2'))
    with pytest.raises(NewerFormatError):
        read_index(index.replace(b'"cell_m":0.05', b'"cell_m":0.1'))
