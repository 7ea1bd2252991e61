"""Tiles as bytes: the documented layout, what is lost, what is refused. Codes keep what they promise and are stable."""

import struct
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap.errors import MapFormatError
from fleetmap.geometry import rotation_angle_rad, rotation_from_quat_wxyz, se3, so3_exp
from fleetmap.mapformat import tile as quantise
from fleetmap.mapformat.container import pack, unpack
from fleetmap.mapformat.tile import LANDMARK_BYTES, MAX_TILE_PLACES, Tile, decode_tile, encode_tile
from support.storage.map_samples import random_tile

LIMIT = 64 << 20


@contextmanager
def at_most(time_s: float, peak_bytes: int) -> Iterator[None]:
    """Of this process's time, and of memory beyond what it has."""
    started_s = time.process_time()
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < peak_bytes and time.process_time() - started_s < time_s


def golden_tile() -> Tile:
    """Two landmarks, one place, numbers that the format holds exactly."""
    return Tile(
        tile_x=-1,
        tile_y=2,
        size_m=16.0,
        landmark_ids=np.array([7, 300], np.uint32),
        points_map=np.array([[-16.0, 32.5, -1.0], [-0.5, 47.0, 2.0]]),
        descriptors=np.arange(64, dtype=np.uint8).reshape(2, 32),
        view_directions_map=np.array([[1, 0, 0], [0, 0, 1]], np.float32),
        view_half_angle_rad=np.array([0, np.pi], np.float32),
        max_distance_m=np.array([0.2, 12.8], np.float32),
        sigma_m=np.array([1e-4, 1.6e-3], np.float32),
        place_ids=np.array([5], np.uint32),
        map_from_cam=se3(np.eye(3), np.array([-8.0, 40.25, 1.0]))[None],
        place_landmark_ids=(np.array([7, 300, 65536 + 300], np.uint32),),
    )


def golden_payload() -> bytes:
    """The same tile written by hand from docs/map_format.md, not by the code under test."""
    q = 512
    landmark_planes = bytes([7, 37, 0, 1, 0, 0, 0, 0])  # 7, then 300 - 7 = 293 = 0x125
    x = [0, int(15.5 * q)]
    y = [int(0.5 * q), 15 * q]
    z = [0, 3 * q]
    return b"".join(
        [
            struct.pack("<iidiIII", -1, 2, 16.0, -1 * q, 2, 1, 3),
            landmark_planes,
            *(bytes(value >> shift & 255 for value in axis) for axis in (x, y) for shift in (0, 8)),
            *(bytes(value >> shift & 255 for value in z) for shift in (0, 8, 16)),
            bytes(range(64)),
            bytes([42, 0, 0, 0]),
            bytes([0, 60]),
            bytes([8, 56]),  # 0.1 m * 2 ** (8 / 8), 0.1 m * 2 ** (56 / 8)
            bytes([0, 16]),  # 0.1 mm * 2 ** (16 / 4)
            bytes([5, 0, 0, 0]),
            struct.pack("<iii", int(-8.0 * 65536), int(40.25 * 65536), 65536),
            bytes([0]),
            bytes(6),
            bytes([3, 0, 0, 0]),
            bytes([7, 37, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]),  # 7, 293, 65536, as four planes
        ]
    )


def test_layout_is_the_documented_one() -> None:
    assert unpack(b"FMTL", 2, encode_tile(golden_tile()), "tile", LIMIT) == golden_payload()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.integers(0, 4), st.sampled_from([16.0, 10.0, 7.3]))
def test_round_trip_loses_only_what_is_documented(seed: int, landmarks: int, places: int, size_m: float) -> None:
    tile = random_tile(np.random.default_rng(seed), landmarks=landmarks, places=places, size_m=size_m)
    data = encode_tile(tile)
    back = decode_tile(data)
    assert encode_tile(back) == data
    for name in ("tile_x", "tile_y", "size_m", "landmark_ids", "descriptors", "place_ids"):
        assert np.array_equal(getattr(back, name), getattr(tile, name)), name
    assert [ids.tolist() for ids in back.place_landmark_ids] == [ids.tolist() for ids in tile.place_landmark_ids]
    quantum_m = size_m / 8192
    # Half a quantum, except at the far edge, where the last code must do for the last whole quantum.
    assert np.abs(back.points_map - tile.points_map).max(initial=0) <= quantum_m
    assert np.quantile(np.abs(back.points_map - tile.points_map), 0.9) <= quantum_m / 2 + 1e-12 if landmarks else True
    assert np.abs(back.map_from_cam[:, :3, 3] - tile.map_from_cam[:, :3, 3]).max(initial=0) <= 0.5 / 65536 + 1e-9
    for mine, theirs in zip(back.map_from_cam, tile.map_from_cam, strict=True):
        assert rotation_angle_rad(mine[:3, :3].T @ theirs[:3, :3]) < 1e-4


def test_landmarks_take_48_bytes_before_compression() -> None:
    tiles = (random_tile(np.random.default_rng(0), landmarks=count, places=0) for count in (0, 1000))
    sizes = [len(unpack(b"FMTL", 2, encode_tile(tile), "", LIMIT)) for tile in tiles]
    assert sizes[1] - sizes[0] == 1000 * LANDMARK_BYTES == 48_000


def test_every_truncation_and_every_flipped_byte_is_refused() -> None:
    data = encode_tile(golden_tile())
    for damaged in (*(data[:length] for length in range(len(data))), data + b"\0"):
        with pytest.raises(MapFormatError):
            decode_tile(damaged)
    for position in range(len(data)):
        for mask in (0x01, 0x80, 0xFF):
            damaged = bytearray(data)
            damaged[position] ^= mask
            try:
                assert encode_tile(decode_tile(bytes(damaged))) == data, position
            except MapFormatError:
                continue


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=400), st.integers(0, 40), st.integers(0, 3), st.integers(0, 9))
def test_hostile_payloads_are_refused_or_decoded(body: bytes, count: int, places: int, references: int) -> None:
    head = struct.pack("<iidiIII", 0, 0, 16.0, 0, count, places, references)
    size = count * 48 + places * 27 + references * 4
    payload = head + (body * (size // max(len(body), 1) + 1))[:size]
    try:
        decode_tile(pack(b"FMTL", 2, payload, level=1))
    except MapFormatError as error:
        assert str(error)


def test_bombs_are_refused_before_they_are_unpacked() -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(300 << 20))
    honest = struct.pack("<4sHHI", b"FMTL", 2, 0, 300 << 20) + bomb
    lying = struct.pack("<4sHHI", b"FMTL", 2, 0, 1000) + bomb
    counts = pack(b"FMTL", 2, struct.pack("<iidiIII", 0, 0, 16.0, 0, 2**32 - 1, 2**32 - 1, 2**32 - 1))
    for data in (honest, lying, counts):
        with at_most(1.6, 1 << 20), pytest.raises(MapFormatError):
            decode_tile(data)
    assert len(bomb) < 1 << 16
    assert len(zstandard.ZstdDecompressor().decompress(lying[12:])) == 300 << 20, "the control"


def test_tiles_that_break_their_own_rules_are_not_written() -> None:
    tile = golden_tile()
    for change, words in (
        ({"landmark_ids": tile.landmark_ids[::-1].copy()}, "strictly increasing"),
        ({"landmark_ids": tile.landmark_ids.astype(np.int64)}, "uint32"),
        ({"points_map": tile.points_map + np.array([100.0, 0, 0])}, "outside"),
        ({"points_map": tile.points_map * np.nan}, "not finite"),
        ({"points_map": tile.points_map + np.array([[0, 0, 0], [0, 0, 1e5]])}, "24 bits"),
        ({"descriptors": tile.descriptors[:, :31]}, "shape"),
        ({"view_directions_map": tile.view_directions_map * 2}, "lengths"),
        ({"size_m": -1.0}, "size_m"),
        ({"tile_x": 1 << 31}, "too far"),
        ({"place_landmark_ids": ()}, "0 landmark lists"),
    ):
        with pytest.raises(MapFormatError, match=words):
            encode_tile(replace(tile, **change))


def test_many_places_cannot_take_long() -> None:
    places = MAX_TILE_PLACES + 1
    head = struct.pack("<iidiIII", 0, 0, 16.0, 0, 0, places, 0)
    with pytest.raises(MapFormatError, match="places"):
        decode_tile(pack(b"FMTL", 2, head + bytes(27 * places), level=1))


# Map bytes from an attacker: never anything but the project's own errors, and little time and memory for the worst.

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
def test_the_fullest_tile_takes_little_time_and_memory(kind: str) -> None:
    data = pack(b"FMTL", 2, fullest_tile(kind), level=1)
    assert len(data) < 2000
    with at_most(3, 12 * _LIMIT):  # a tenth of the time, measured
        decode_tile(data)


def test_every_direction_code_is_stable_and_directions_are_good_to_their_step() -> None:
    axis = np.arange(-42, 43)
    codes = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2).astype(np.int8)
    first = quantise.direction_code(quantise.direction_value(codes))
    assert np.array_equal(quantise.direction_code(quantise.direction_value(first)), first)
    # Only codes on the folded edge have a second spelling.
    changed = (first != codes).any(axis=1)
    assert (np.abs(codes[changed].astype(int)).max(axis=1) == 42).all()
    directions = np.random.default_rng(1).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    back = quantise.direction_value(quantise.direction_code(directions.astype(np.float32)))
    cosines = np.clip((directions * back).sum(axis=1), -1, 1)
    assert np.degrees(np.arccos(cosines)).max() < 3.0
    assert np.allclose(np.linalg.norm(back, axis=1), 1, atol=1e-6)


def _check_rotation(rotation: np.ndarray) -> None:
    code = quantise.rotation_code(rotation)
    back = quantise.rotation_values(np.array([code[0]], np.uint8), code[1][None])[0]
    assert np.allclose(back, rotation_from_quat_wxyz(np.insert(code[1] / 32767, code[0], 1.0)), atol=1e-15)
    assert rotation_angle_rad(rotation.T @ back) < 1e-4
    again = quantise.rotation_code(back)
    assert again[0] == code[0] and np.array_equal(again[1], code[1])


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rotations_are_stable(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _check_rotation(so3_exp(rng.normal(size=3) * rng.choice([1e-9, 1e-4, 1.0, 3.0])))


def test_rotations_with_ties_are_stable() -> None:
    # Quaternions whose largest components are equal, or nearly: there the choice of the largest is delicate.
    for base in ((1, 1, 1, 1), (1, 1, 0, 0), (1, 1, 1, 0), (1, 1 - 1e-5, 0.3, 0), (1, 1 - 2e-5, 1 - 1e-5, 0.1)):
        for order, signs in product(set(permutations(base)), product((1, -1), repeat=4)):
            _check_rotation(rotation_from_quat_wxyz(np.array(order) * np.array(signs)))


def test_codes_of_distances_and_angles_clip_and_are_within_half_a_step() -> None:
    values = np.geomspace(0.11, 600, 500).astype(np.float32)
    codes = quantise.log_code(values, 0.1, 20)
    back = quantise.log_value(codes, 0.1, 20)
    assert np.abs(np.log2(back / values)).max() <= 0.5 / 20 + 1e-6
    assert np.array_equal(quantise.log_code(back, 0.1, 20), codes)
    assert quantise.log_code(np.array([0.0, 1e9], np.float32), 0.1, 20).tolist() == [0, 255]
    angles = np.linspace(0, np.pi, 500).astype(np.float32)
    codes = quantise.half_angle_code(angles)
    back = quantise.half_angle_value(codes)
    assert np.abs(back - angles).max() <= np.pi / 120 + 1e-6
    assert np.array_equal(quantise.half_angle_code(back), codes)
    assert quantise.half_angle_value(np.array([60, 255], np.uint8)).tolist() == [np.float32(np.pi)] * 2
