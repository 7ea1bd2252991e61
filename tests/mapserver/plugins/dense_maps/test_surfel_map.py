"""Surfels as bytes and back, through the store and its exports, and what is no surfel told by name."""

import struct

import msgspec
import numpy as np
import pytest
from scipy.spatial import cKDTree

from fleetmap.errors import MapFormatError, NewerFormatError, StateError
from mapserver.plugins.dense_maps.surfel_map import LEVELS, TILE_SIZE_M, Surfels, surfels_of
from mapserver.store import MapStore
from support.storage.dense_samples import encode_surfels, save_surfel_draft, wall
from support.storage.map_samples import save_sample_draft


def scattered(count: int = 4000) -> Surfels:
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = rng.uniform([-40, -20, -3], [40, 20, 6], (count, 3))
    levels, greys = rng.integers(0, LEVELS, count).astype(np.uint8), rng.integers(0, 256, count).astype(np.uint8)
    return Surfels(points.astype(np.float32), normals.astype(np.float32), levels, greys, (-1.5, 0.5, 0.1))


def test_bytes_are_the_same_in_any_order_and_give_the_surfels_back() -> None:
    surfels = scattered()
    blobs = encode_surfels(surfels)
    assert blobs == encode_surfels(surfels[np.random.default_rng(1).permutation(len(surfels))])
    assert len(blobs) == 1 + len(np.unique(np.floor(surfels.points_map[:, :2] / TILE_SIZE_M), axis=0))
    with_store = {msgspec.json.decode(blobs[0])["tiles"][i]["sha256"]: data for i, data in enumerate(blobs[1:])}
    assert len(with_store) == len(blobs) - 1
    assert encode_surfels(Surfels.joined([])) == []


def test_a_version_keeps_them_and_gives_those_that_are_near(store: MapStore) -> None:
    surfels = scattered()
    manifest = store.manifest("lab", save_surfel_draft(store, surfels))
    found = surfels_of(manifest, store.blob)
    near = surfels_of(manifest, store.blob, (1.0, 1.0, 2.0))
    assert (len(found), found.falloff) == (len(surfels), surfels.falloff)
    meant = surfels[:50]
    picked = found[cKDTree(found.points_map).query(meant.points_map)[1]]
    np.testing.assert_allclose(picked.points_map, meant.points_map, atol=6e-4)
    assert (picked.normals * meant.normals).sum(axis=1).min() > np.cos(np.radians(1.0))
    np.testing.assert_array_equal(picked.levels, meant.levels)
    np.testing.assert_array_equal(picked.greys, meant.greys)
    assert 0 < len(near) < len(found)
    assert (np.abs(near.points_map[:, :2] - 1.0) <= TILE_SIZE_M + 2.0).all()


def test_surfels_far_above_or_below_their_tile_are_left_out(store: MapStore) -> None:
    surfels = scattered()
    stray = surfels[np.array([0, 1])]
    stray.points_map[:, 2] += [70.0, -70.0]
    manifest = store.manifest("lab", save_surfel_draft(store, Surfels.joined([surfels, stray])))
    found = surfels_of(manifest, store.blob)
    assert len(found) == len(surfels)
    assert found.points_map[:, 2].min() == pytest.approx(surfels.points_map[:, 2].min(), abs=1e-3)
    assert found.points_map[:, 2].max() == pytest.approx(surfels.points_map[:, 2].max(), abs=1e-3)


def test_what_is_not_there_or_damaged_is_told(store: MapStore) -> None:
    bare = store.manifest("lab", save_sample_draft(store))
    with pytest.raises(StateError, match="surfel_map = true"):
        surfels_of(bare, store.blob)
    manifest = store.manifest("lab", save_surfel_draft(store, wall()))
    blobs = encode_surfels(wall())
    for said, kind, words in (
        ({"without": {"ride": "one camera measures no depth"}}, StateError, "ride: one camera"),
        ({"sha256": "x"}, MapFormatError, "surfels"),
    ):
        with pytest.raises(kind, match=words):
            surfels_of(msgspec.structs.replace(manifest, report={"surfels": said}), {}.__getitem__)
    first, second = (tile["sha256"] for tile in msgspec.json.decode(blobs[0])["tiles"][:2])
    newer_tile = blobs[1][:4] + struct.pack("<H", 2) + blobs[1][6:]
    for index, tiles, kind, words in (
        (b"{}[", {}, MapFormatError, "index of surfels"),
        (blobs[0].replace(b'"format_version":1', b'"format_version":2'), {}, NewerFormatError, "format 2"),
        (blobs[0], {first: newer_tile}, NewerFormatError, "format 2"),
        (blobs[0], {first: blobs[2], second: blobs[1]}, MapFormatError, "is at the place of"),
        (blobs[0], {first: blobs[1][:40]}, MapFormatError, "surfel tile"),
    ):
        known = {manifest.report["surfels"]["sha256"]: index, first: blobs[1], second: blobs[2]} | tiles
        with pytest.raises(kind, match=words):
            surfels_of(manifest, known.__getitem__)
