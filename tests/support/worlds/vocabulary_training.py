"""Training of vocabularies: how the one that ships was made, and small ones for tests."""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.bow.vocabulary import VOCABULARY_FORMAT, Vocabulary
from fleetmap.features.matching import FAR, Descriptors, packed
from fleetmap.geometry import Array

_ITERATIONS = 8
Packed, Indices = NDArray[np.uint64], NDArray[np.int64]


def train_vocabulary(
    descriptors: Descriptors,
    branching: int,
    levels: int,
    rng: np.random.Generator,
    images: NDArray[np.integer] | None = None,
) -> Vocabulary:
    """A tree with at most `branching` children a node and `levels` levels below the root, of descriptors (N, 32).

    images (N,): which image each descriptor is from, for the words' rarity; without it, or with one image only, all
    words weigh the same. A node with no more members than `branching`, or with equal ones, stays a leaf; no descriptors
    at all make a vocabulary of one word. The same input and generator state give the same vocabulary.
    """
    assert 2 <= branching <= 64
    assert 1 <= levels < 16
    bits = packed(descriptors)
    centres, counts = [np.zeros((1, 4), np.uint64)], []
    layer = [np.arange(len(bits))]
    for _ in range(levels):
        below: list[Indices] = []
        for members in layer:
            groups = _split(bits, members, branching, rng)
            counts.append(len(groups))
            centres.extend(centre[None] for centre, _ in groups)
            below.extend(group for _, group in groups)
        layer = below
    counts.extend([0] * len(layer))
    child_count = np.array(counts, np.int32)
    first_child = (1 + np.cumsum(child_count) - child_count).astype(np.int32)
    first_child[child_count == 0] = 0
    tree = Vocabulary(
        np.concatenate(centres), first_child, child_count, np.ones(int((child_count == 0).sum()), np.float32)
    )
    return Vocabulary(tree.centres, first_child, child_count, _idf(tree, descriptors, images))


def _split(bits: Packed, members: Indices, branching: int, rng: np.random.Generator) -> list[tuple[Packed, Indices]]:
    """Centre and members of each child; none where the node is to stay a leaf."""
    if len(members) <= branching:
        return []
    own = bits[members]
    centres = seed_centres(own, branching, rng.random(branching))
    if len(centres) < 2:
        return []
    labels = cluster(own, centres, _ITERATIONS)
    groups = [(centres[c], members[labels == c]) for c in range(len(centres))]
    kept = [(centre, group) for centre, group in groups if len(group) > 0]
    return kept if len(kept) > 1 else []


def _idf(tree: Vocabulary, descriptors: Descriptors, images: NDArray[np.integer] | None) -> NDArray[np.float32]:
    """log(1 + images / images with the word): as in text retrieval, but never 0, for sites of few images."""
    if images is None or len(images) == 0 or images.min() == images.max():
        return tree.idf
    assert len(images) == len(descriptors)
    numbers, image = np.unique(images, return_inverse=True)
    seen = np.unique(np.column_stack([tree.words(descriptors), image]), axis=0)[:, 0]
    holding = np.bincount(seen, minlength=tree.word_count)
    return np.log(1.0 + len(numbers) / np.maximum(holding, 1)).astype(np.float32)


def seed_centres(bits: Packed, branching: int, uniforms: Array) -> Packed:
    """Up to `branching` distinct descriptors of (M, 4), spread out; fewer where there are fewer. Source: Arthur 2007 (k-means++)."""
    centres = bits[[int(uniforms[0] * len(bits))]]
    squared = np.full(len(bits), FAR * FAR)
    while True:
        apart = np.unpackbits((bits ^ centres[-1]).view(np.uint8), axis=1).sum(axis=1, dtype=np.int64)
        squared = np.minimum(squared, apart**2)
        passed = np.cumsum(squared)
        if len(centres) == branching or passed[-1] == 0:
            return centres
        pick = int(np.searchsorted(passed, uniforms[len(centres)] * passed[-1], side="right"))
        centres = np.concatenate([centres, bits[pick : pick + 1]])


def cluster(bits: Packed, centres: Packed, iterations: int) -> Indices:
    """Label (M,) of the nearest centre of descriptors (M, 4) after refining `centres` in place. Source: Grana 2013 (k-majority).

    A centre is the bit-wise majority of its members (ties: 0). One without members stays unchanged.
    """
    labels, each = np.full(len(bits), -1), np.unpackbits(bits.view(np.uint8), axis=1, bitorder="little")
    for _ in range(iterations):
        before, labels = labels, core.nearest_cells(bits, centres, 1)[:, 0]
        if np.array_equal(labels, before):
            break
        counts = np.bincount(labels, minlength=len(centres))
        held = np.flatnonzero(counts)
        firsts = (np.cumsum(counts) - counts)[held]
        ones = np.add.reduceat(each[np.argsort(labels, kind="stable")], firsts, axis=0, dtype=np.int64)
        majority = np.packbits(2 * ones > counts[held, None], axis=1, bitorder="little")
        centres[held] = majority.view(np.uint64)
    return labels


def changed(descriptors: Descriptors, bits: int, rng: np.random.Generator) -> Descriptors:
    """Each with so many of its bits changed."""
    flips = np.argsort(rng.random((len(descriptors), 256)), axis=1) < bits
    return descriptors ^ np.packbits(flips, axis=1)


def encode_vocabulary(vocabulary: Vocabulary) -> bytes:
    """Encode a vocabulary; equal vocabularies give equal bytes on every machine."""
    nodes = len(vocabulary.child_count)
    body = (
        vocabulary.child_count.astype(np.uint8).tobytes()
        + np.ascontiguousarray(vocabulary.centres, "<u8").tobytes()
        + np.ascontiguousarray(vocabulary.idf, "<f4").tobytes()
    )
    return struct.pack("<4sHHIII", b"FMVB", VOCABULARY_FORMAT, 0, nodes, vocabulary.word_count, zlib.crc32(body)) + body
