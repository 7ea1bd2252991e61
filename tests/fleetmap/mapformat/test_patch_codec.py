"""Patches: the newer tile out of the older one, bit by bit, and nothing out of anything else."""

import struct
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap.errors import MapFormatError, NewerFormatError
from fleetmap.mapformat import Tile, apply_patch, decode_tile, encode_tile, make_patch, pack, sha256_hex, unpack
from support.storage.map_samples import random_tile

LIMIT = 64 << 20


def changed(tile: Tile, rng: np.random.Generator, share: float, places: bool = True) -> Tile:
    """A night later: a share of the landmarks gone, as many moved, as many new; places lose what is gone."""
    count = max(1, round(share * len(tile)))
    order = rng.permutation(len(tile))
    gone, moved = order[:count], order[count : 2 * count]
    other = random_tile(rng, landmarks=count, places=0, cell=(tile.tile_x, tile.tile_y), size_m=tile.size_m)
    points = tile.points_map.copy()
    points[moved, 2] += 1.0
    fresh_ids = (int(tile.landmark_ids[-1]) + 1 + np.arange(len(other))).astype(np.uint32)
    kept = np.setdiff1d(np.arange(len(tile)), gone)
    columns = {
        field: np.concatenate([values[kept], getattr(other, field)])
        for field, values in (
            ("points_map", points),
            *(
                (field, getattr(tile, field))
                for field in ("descriptors", "view_directions_map", "view_half_angle_rad", "max_distance_m", "sigma_m")
            ),
        )
    }
    lists = [np.setdiff1d(ids, tile.landmark_ids[gone]).astype(np.uint32) for ids in tile.place_landmark_ids]
    if places and lists:
        lists[-1] = np.union1d(lists[-1], fresh_ids).astype(np.uint32)
    ids = np.concatenate([tile.landmark_ids[kept], fresh_ids])
    return replace(tile, landmark_ids=ids, place_landmark_ids=tuple(lists), **columns)


def test_one_landmark_less_costs_hardly_more_than_the_addresses() -> None:
    """A site has many tiles, and in most nights little changes in each."""
    tile = random_tile(np.random.default_rng(4), landmarks=900, places=20)
    kept = np.arange(len(tile)) != 450
    names = (
        "landmark_ids",
        "points_map",
        "descriptors",
        "view_directions_map",
        "view_half_angle_rad",
        "max_distance_m",
        "sigma_m",
    )
    lists = tuple(ids[ids != tile.landmark_ids[450]] for ids in tile.place_landmark_ids)
    less = replace(tile, place_landmark_ids=lists, **{name: getattr(tile, name)[kept] for name in names})
    base, result = encode_tile(tile), encode_tile(less)
    patch = make_patch(base, result)
    assert apply_patch(base, patch) == result
    assert len(patch) < 64 + 70


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 60), st.integers(0, 4), st.floats(0, 0.3))
def test_a_patched_tile_is_the_newer_one(seed: int, landmarks: int, places: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    tile = random_tile(rng, landmarks=landmarks, places=places)
    base, result = encode_tile(tile), encode_tile(changed(tile, rng, share))
    assert apply_patch(base, make_patch(base, result)) == result
    assert apply_patch(result, make_patch(result, base)) == base
    assert apply_patch(base, make_patch(base, base)) == base


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_tiles_with_nothing_in_common_can_be_patched(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, 30, 2), rng.integers(0, 4, 2)
    a, b = (random_tile(rng, landmarks=int(n), places=int(k)) for n, k in zip(*sizes, strict=True))
    base, result = encode_tile(a), encode_tile(b)
    assert apply_patch(base, make_patch(base, result)) == result


def test_places_come_go_and_move() -> None:
    rng = np.random.default_rng(3)
    tile = random_tile(rng, landmarks=50, places=4)
    moved = tile.map_from_cam.copy()
    moved[1, 2, 3] += 0.5
    ids = tile.place_ids.copy()
    ids[3] += 1
    other = replace(tile, map_from_cam=moved, place_ids=ids)
    base, result = encode_tile(tile), encode_tile(other)
    assert apply_patch(base, make_patch(base, result)) == result
    assert len(make_patch(base, result)) < 300


def test_a_patch_costs_what_changed() -> None:
    rng = np.random.default_rng(1)
    tile = random_tile(rng, landmarks=4000, places=0)
    base = encode_tile(tile)
    assert len(make_patch(base, base)) < 200
    later = encode_tile(changed(tile, rng, 0.05))
    # 200 new landmarks are 8 kB; those that moved keep their descriptors.
    assert 0.05 < len(make_patch(base, later)) / len(later) < 0.08


def test_other_bytes_are_patched_with_the_old_ones_before_them() -> None:
    rng = np.random.default_rng(2)
    base = rng.bytes(5000)
    result = base[:2000] + b"new" + base[2000:]
    patch = make_patch(base, result)
    assert apply_patch(base, patch) == result
    assert len(patch) < 200
    assert apply_patch(b"", make_patch(b"", b"manifest")) == b"manifest"
    assert apply_patch(b"old", make_patch(b"old", b"")) == b""


def test_every_truncation_flip_and_wrong_base_is_refused() -> None:
    rng = np.random.default_rng(5)
    tile = random_tile(rng, landmarks=12, places=2)
    base, result = encode_tile(tile), encode_tile(changed(tile, rng, 0.1))
    patch = make_patch(base, result)
    for wrong in (result, encode_tile(random_tile(rng)), b"", b"FMTL", bytes(100)):
        with pytest.raises(MapFormatError):
            apply_patch(wrong, patch)
    for position in range(len(patch)):
        with pytest.raises(MapFormatError):
            apply_patch(base, patch[:position])
        for mask in (0x01, 0x80):
            damaged = bytearray(patch)
            damaged[position] ^= mask
            try:
                assert apply_patch(base, bytes(damaged)) == result, position
            except MapFormatError:
                continue
    with pytest.raises(NewerFormatError, match="up to 1"):
        apply_patch(base, patch[:4] + b"\x09" + patch[5:])


def test_what_cannot_be_patched_is_told() -> None:
    tile = encode_tile(random_tile(np.random.default_rng(1)))
    payload = unpack(b"FMTL", 2, tile, "tile", LIMIT)[1]
    older = pack(b"FMTL", 1, payload)
    with pytest.raises(MapFormatError, match="send it whole"):
        make_patch(tile, older)
    # Compressed otherwise, as by another release of zstd: only who applies the patch can tell.
    respelled = pack(b"FMTL", 2, payload, level=1)
    with pytest.raises(MapFormatError, match="SHA-256"):
        apply_patch(tile, make_patch(tile, respelled))
    elsewhere = encode_tile(random_tile(np.random.default_rng(1), cell=(0, 0)))
    with pytest.raises(MapFormatError, match="elsewhere"):
        make_patch(tile, elsewhere)
    with pytest.raises(MapFormatError, match="damaged"):
        make_patch(tile[:-1], tile)
    with pytest.raises(MapFormatError, match="too many"):
        make_patch(bytes(12 << 20), bytes(12 << 20))


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300), *[st.integers(0, 9)] * 4, st.integers(0, 2), st.integers(0, 3))
def test_hostile_patches_are_refused(
    body: bytes, landmarks: int, places: int, lists: int, changes: int, kind: int, number: int
) -> None:
    base = encode_tile(random_tile(np.random.default_rng(9)))
    payload = unpack(b"FMTL", 2, base, "tile", LIMIT)[1]
    head = struct.pack(
        "<32s32sBBHIIII", bytes.fromhex(sha256_hex(base)), bytes(32), kind, number, 0, landmarks, places, lists, changes
    )
    with pytest.raises(MapFormatError):
        apply_patch(base, pack(b"FMPT", 1, head + body, level=1, prefix=payload))


def test_huge_counts_are_refused_at_once() -> None:
    base = encode_tile(random_tile(np.random.default_rng(9)))
    payload = unpack(b"FMTL", 2, base, "tile", LIMIT)[1]
    head = struct.pack("<32s32sBBHIIII", bytes.fromhex(sha256_hex(base)), bytes(32), 1, 2, 0, *[2**32 - 1] * 4)
    started = time.perf_counter()
    with pytest.raises(MapFormatError):
        apply_patch(base, pack(b"FMPT", 1, head, level=1, prefix=payload))
    assert time.perf_counter() - started < 1


def test_patches_of_the_first_release_can_be_applied() -> None:
    # Written by the release that brought the format; never to be changed. Server and robot may be of different ones.
    base = bytes.fromhex(GOLDEN_TILE_HEX)
    result = decode_tile(apply_patch(base, bytes.fromhex(GOLDEN_PATCH_HEX)))
    assert result.points_map[1].tolist() == [-0.5, 47.0, 3.0]
    assert [ids.tolist() for ids in result.place_landmark_ids] == [[7, 300]]
    assert apply_patch(b"the old manifest", bytes.fromhex(GOLDEN_BYTES_PATCH_HEX)) == b"the new manifest"


GOLDEN_TILE_HEX = (
    "464d544c02000000a700000028b52ffd24a7000100ffffffff02000000000000000000304000feffff02000000010000"
    "000300000040000007250001000000002000000000001f2000000000011e300000000000060000000200000102030405"
    "060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f202122232425262728292a2b2c2d2e2f303132333435"
    "363738393a3b3c3d3e3f2000002a000000100000003c10000008381000000010d80000050000000000f8ff0040280000"
    "0001000000000000000003000000600000072500000100000001000000010000725fc30a"
)
GOLDEN_PATCH_HEX = (
    "464d505401000000b000000028b52ffd24b0640200140405ff2dcc7afce05f4111cf83bb2446d5e7977aa3ddd9fbfebe"
    "2898af40f97fd39a4eae534f1700f2757837fe75d493278fabbb5d1371dd76ca457ead1d5937cb010200576c08ce8531"
    "0320000005000000200000010000002000002c0101006c000010ff060300b8851feb1410ca062000002c010000100000"
    "001f100000001e18000000000044000008200100dfc6080110000000000800003c08000038080000100100001bcd0a95"
)
GOLDEN_BYTES_PATCH_HEX = (
    "464d5054010000006400000028b52ffd24644c020024043646805089d04dccd103a08fbb221372224b5a75fda6c1cbc4"
    "ab982295513222a5ef1f09b5bb7beaf692ab28fd60338d5b6d5800b4ac49e09aef44f055060c6b000001008207a26c00"
    "0038746865206e6577010067118c0100004ed78027"
)
