"""The vocabulary against twins in numpy, and its bytes against damage."""

import struct
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap.bow.vocabulary import Vocabulary, decode_vocabulary
from fleetmap.errors import MapFormatError, NewerFormatError
from support.worlds.vocabulary_training import encode_vocabulary, train_vocabulary


def _trained(seed: int = 0, clusters: int = 40, each: int = 30) -> tuple[Vocabulary, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    centres = rng.integers(0, 256, (clusters, 32), dtype=np.uint8)
    descriptors = np.repeat(centres, each, axis=0) ^ np.packbits(rng.random((clusters * each, 256)) < 0.05, axis=1)
    images = rng.integers(0, 12, len(descriptors))
    return train_vocabulary(descriptors, 4, 3, np.random.default_rng(7), images), descriptors, images


def _walk(vocabulary: Vocabulary, descriptor: np.ndarray) -> int:
    """The word of one descriptor, step by step."""
    centres = vocabulary.centres.view(np.uint8).reshape(-1, 32)
    node = 0
    while vocabulary.child_count[node]:
        children = range(vocabulary.first_child[node], vocabulary.first_child[node] + vocabulary.child_count[node])
        node = min(children, key=lambda c: (int(np.unpackbits(centres[c] ^ descriptor).sum()), c))
    return int((vocabulary.child_count[:node] == 0).sum())


def test_words_are_those_of_the_walk_down_the_tree() -> None:
    vocabulary, descriptors, _ = _trained()
    strangers = np.random.default_rng(3).integers(0, 256, (50, 32), dtype=np.uint8)
    sample = np.concatenate([descriptors[::17], strangers])
    words = vocabulary.words(sample)
    assert words.dtype == np.int32
    assert [_walk(vocabulary, d) for d in sample] == words.tolist()
    assert 16 < vocabulary.word_count <= 4**3


def test_branches_are_the_two_nearest_children_of_the_root() -> None:
    vocabulary, descriptors, _ = _trained()
    centres = vocabulary.centres[1 : 1 + vocabulary.child_count[0]].view(np.uint8).reshape(-1, 32)
    distances = np.unpackbits(descriptors[:, None] ^ centres[None], axis=2).sum(2)
    np.testing.assert_array_equal(vocabulary.branches(descriptors), np.argsort(distances, axis=1, kind="stable")[:, :2])
    single = train_vocabulary(np.zeros((0, 32), np.uint8), 4, 3, np.random.default_rng(0))
    assert (single.branches(descriptors) == 0).all()


def test_bow_vector_is_normalised_tf_idf() -> None:
    vocabulary, _, _ = _trained()
    vector = vocabulary.bow_vector(np.array([5, 2, 5, 9, 5], np.int32))
    assert vector.word_ids.tolist() == [2, 5, 9]
    raw = np.array([1, 3, 1]) * vocabulary.idf[[2, 5, 9]]
    np.testing.assert_allclose(vector.weights, raw / raw.sum(), rtol=1e-6)
    empty = vocabulary.bow_vector(np.zeros(0, np.int32))
    assert len(empty) == 0


@settings(max_examples=25, deadline=None)
@given(count=st.integers(0, 300), branching=st.integers(2, 12), levels=st.integers(1, 4), seed=st.integers(0, 99))
def test_bytes_go_there_and_back(count: int, branching: int, levels: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    vocabulary = train_vocabulary(descriptors, branching, levels, rng, rng.integers(0, 5, count))
    again = decode_vocabulary(encode_vocabulary(vocabulary))
    for name in ("centres", "first_child", "child_count", "idf"):
        np.testing.assert_array_equal(getattr(again, name), getattr(vocabulary, name))
        assert getattr(again, name).dtype == getattr(vocabulary, name).dtype
    np.testing.assert_array_equal(again.words(descriptors), vocabulary.words(descriptors))


def test_every_flipped_bit_and_every_cut_is_refused() -> None:
    data = encode_vocabulary(_trained(clusters=5, each=8)[0])
    for position in range(0, len(data), 7):
        damaged = bytearray(data)
        damaged[position] ^= 1 << (position % 8)
        with pytest.raises(MapFormatError):
            decode_vocabulary(bytes(damaged))
    for damaged in (*(data[:size] for size in (0, 3, 19, 20, len(data) - 1)), data + b"\0"):
        with pytest.raises(MapFormatError):
            decode_vocabulary(damaged)


@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=200), counts=st.lists(st.integers(0, 255), max_size=8), words=st.integers(0, 9))
def test_made_up_bytes_with_a_right_checksum_are_refused_or_sound(data: bytes, counts: list[int], words: int) -> None:
    body = bytes(counts) + bytes(32 * len(counts)) + (data * 4)[: 4 * words]
    forged = struct.pack("<4sHHIII", b"FMVB", 1, 0, len(counts), words, zlib.crc32(body)) + body
    try:
        vocabulary = decode_vocabulary(forged)
    except MapFormatError:
        return
    found = vocabulary.words(np.zeros((3, 32), np.uint8))  # ends, and stays inside
    assert (found < vocabulary.word_count).all()


def _forged(counts: list[int]) -> bytes:
    words = counts.count(0)
    body = bytes(counts) + bytes(32 * len(counts) + 4 * words)
    return struct.pack("<4sHHIII", b"FMVB", 1, 0, len(counts), words, zlib.crc32(body)) + body


@pytest.mark.parametrize("counts", [[0], [2, 0, 0], [2, 2, 0, 0, 0], [3, 0, 2, 0, 0, 0]])
def test_child_counts_that_make_a_tree(counts: list[int]) -> None:
    assert decode_vocabulary(_forged(counts)).word_count == counts.count(0)


@pytest.mark.parametrize(
    "counts",
    [[0, 0], [1, 0], [2, 0], [2, 2, 0], [2, 0, 0, 0], [2, 0, 0, 2, 0, 0], [0, 2, 0], [2, 0, 2, 0], [2, 0] * 20 + [0]],
    ids=str,
)
def test_child_counts_that_make_no_tree_or_too_deep_a_one(counts: list[int]) -> None:
    with pytest.raises(MapFormatError, match="tree"):
        decode_vocabulary(_forged(counts))


@pytest.mark.parametrize(
    ("field", "value", "error"),
    [(1, 2, NewerFormatError), (1, 0, MapFormatError), (2, 1, MapFormatError), (3, 1 << 30, MapFormatError)],
)
def test_header_fields_are_checked(field: int, value: int, error: type[Exception]) -> None:
    data = encode_vocabulary(_trained(clusters=5, each=8)[0])
    header: list[Any] = list(struct.unpack_from("<4sHHIII", data))
    header[field] = value
    with pytest.raises(error, match="vocabulary"):
        decode_vocabulary(struct.pack("<4sHHIII", *header) + data[20:])
