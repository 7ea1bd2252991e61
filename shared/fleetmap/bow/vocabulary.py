"""A tree of binary words: a descriptor descends to the nearest child until it reaches a leaf, which is its word. As bytes:

    offset  type     content
    0       4 s      magic FMVB
    4       u16      format number
    6       u16      0
    8       u32      M nodes
    12      u32      W words
    16      u32      CRC-32 of everything behind it
    20      M   u8   number of children of each node, breadth first
            32 M u8  centre of each node
            4 W f32  idf of each word

Little-endian. Not compressed: centres are close to random bits. The index of a node's first child follows from the counts.
"""

import struct
import zlib
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.errors import MapFormatError, check_format
from fleetmap.features.matching import Descriptors, Packed, packed
from fleetmap.geometry import Array32, Indices, Mask

WordIds = NDArray[np.int32]
VOCABULARY_FORMAT = 1
MAX_NODES = 1 << 20
MAX_LEVELS = 16
_MAGIC = b"FMVB"
_HEADER = struct.Struct("<4sHHIII")


@dataclass(frozen=True, slots=True, eq=False)
class BowVector:
    """Appearance of a place: word_ids (W,) ascending, weights (W,) positive with sum 1 (both empty without words)."""

    word_ids: WordIds
    weights: Array32

    def __len__(self) -> int:
        return len(self.word_ids)


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """A tree of M nodes, breadth first from the root (node 0), with W leaves, numbered in that order: the words.

    centres (M, 4) uint64: medians of 256 bits, the root's unused. first_child and child_count (M,): a node's children
    are neighbours; none for a leaf. idf (W,): weight of each word, more for rarer ones.
    """

    centres: Packed
    first_child: NDArray[np.int32]
    child_count: NDArray[np.int32]
    idf: Array32

    @property
    def word_count(self) -> int:
        """Number of words."""
        return len(self.idf)

    def words(self, descriptors: Descriptors) -> WordIds:
        """(N,) word of each descriptor (N, 32). Ties go to the lower node. Source: Nister and Stewenius 2006."""
        word_of_node = (np.cumsum(self.child_count == 0) - 1).astype(np.int32)
        return core.descend(packed(descriptors), self.centres, self.first_child, self.child_count, word_of_node)

    def branches(self, descriptors: Descriptors) -> NDArray[np.int32]:
        """(N, 2) numbers of the two children of the root nearest to each descriptor (N, 32); 0 without children."""
        children = self.centres[1 : 1 + int(self.child_count[0])]
        return np.maximum(core.nearest_cells(packed(descriptors), children, 2), 0)

    def bow_vector(self, words: WordIds) -> BowVector:
        """The tf-idf vector of a place's words (N,), L1-normalised. Source: Galvez-Lopez and Tardos 2012 (DBoW2)."""
        word_ids, counts = np.unique(words, return_counts=True)
        assert len(word_ids) == 0 or (word_ids[0] >= 0 and word_ids[-1] < self.word_count)
        products = counts * self.idf[word_ids].astype(np.float64)
        used = products > 0.0
        weights = products[used] / max(float(products.sum()), 1e-300)
        return BowVector(word_ids[used].astype(np.int32), weights.astype(np.float32))


def decode_vocabulary(data: bytes) -> Vocabulary:
    """Decode the vocabulary in `data`.

    Raises NewerFormatError for a newer format, MapFormatError for anything that is not a whole, undamaged vocabulary.
    Allocates no more than a small multiple of len(data).
    """
    nodes, words = _checked_header(data)
    body = memoryview(data)[_HEADER.size :]
    child_count = np.frombuffer(body, np.uint8, nodes).astype(np.int32)
    centres = np.frombuffer(body, "<u8", 4 * nodes, nodes).reshape(nodes, 4).astype(np.uint64)
    idf = np.frombuffer(body, "<f4", words, 33 * nodes).astype(np.float32)
    first_child = _first_children(child_count, words)
    if not np.isfinite(idf).all() or (idf < 0.0).any():
        raise MapFormatError("vocabulary: a word's weight is negative or not finite; fetch the vocabulary again")
    return Vocabulary(centres, first_child, child_count, idf)


def _checked_header(data: bytes) -> tuple[int, int]:
    """Check the header and the checksum; return the numbers of nodes and words."""
    header = data[: _HEADER.size].ljust(_HEADER.size, b"\0")
    _, number, reserved, nodes, words, checksum = _HEADER.unpack(header)
    check_format("vocabulary", data[:4], _MAGIC, number, VOCABULARY_FORMAT)
    if number < 1 or reserved != 0 or not 1 <= words <= nodes <= MAX_NODES:
        raise MapFormatError(
            f"vocabulary: format {number}, {nodes} nodes, {words} words (at most {MAX_NODES}): damaged, fetch it again"
        )
    if len(data) != _HEADER.size + 33 * nodes + 4 * words:
        raise MapFormatError(f"vocabulary: {len(data)} bytes for {nodes} nodes and {words} words; fetch it again")
    found = zlib.crc32(memoryview(data)[_HEADER.size :])
    if found != checksum:
        raise MapFormatError(f"vocabulary: CRC-32 {found:08x} instead of {checksum:08x}; damaged, fetch it again")
    return nodes, words


def _first_children(child_count: NDArray[np.int32], words: int) -> NDArray[np.int32]:
    """Index of each node's first child; MapFormatError unless the counts make one tree with that many leaves."""
    nodes = len(child_count)
    begin, end = 0, 1
    for _ in range(MAX_LEVELS):  # downwards, one level at a time
        begin, end = end, end + int(child_count[begin:end].sum())
        if begin == end or end > nodes:
            break
    if not begin == end == nodes or (child_count == 1).any() or int((child_count == 0).sum()) != words:
        raise MapFormatError(f"vocabulary: {nodes} nodes and {words} words do not make a tree; fetch it again")
    first_child = 1 + np.cumsum(child_count, dtype=np.int64) - child_count
    return np.where(child_count > 0, first_child, 0).astype(np.int32)


_FIRST_CAPACITY = 64


class PlaceIndex:
    """Growing index of places and their bag-of-words vectors."""

    def __init__(self, word_count: int) -> None:
        """Create an empty index for the words of one vocabulary."""
        self._place_ids, self._count = np.zeros(_FIRST_CAPACITY, np.int64), 0
        self._known: set[int] = set()
        self._file = core.InvertedFile(word_count)

    def __len__(self) -> int:
        return self._count

    @property
    def place_ids(self) -> Indices:
        """(P,) ids in the order of insertion, which is the order of a candidates mask."""
        return self._place_ids[: self._count]

    def add(self, place_id: int, vector: BowVector) -> None:
        """Add a place; its id must be new."""
        assert place_id not in self._known, place_id
        self._known.add(place_id)
        if self._count == len(self._place_ids):
            self._place_ids = np.concatenate([self._place_ids, np.zeros_like(self._place_ids)])
        self._place_ids[self._count] = place_id
        self._count += 1
        self._file.add(vector.word_ids, vector.weights)

    def query(
        self, vector: BowVector, candidates_mask: Mask | None = None, top_k: int = 10
    ) -> tuple[Indices, NDArray[np.float64]]:
        """Return ids and scores of the up to `top_k` most similar places, best first; places without a common word are left out.

        candidates_mask (P,), in the order of `place_ids`, marks the places that may be returned. The score is 1 - |a - b|_1 / 2, in
        0..1, 1 for equal vectors (DBoW2's L1 score). Ties go to the lower id.
        """
        scores = self.scores(vector)
        if candidates_mask is not None:
            assert candidates_mask.shape == scores.shape
            scores = np.where(candidates_mask, scores, 0.0)
        found = np.flatnonzero(scores > 0.0)
        if len(found) > top_k:
            least = np.partition(scores[found], len(found) - top_k)[len(found) - top_k]
            found = found[scores[found] >= least]
        ids = self.place_ids[found]
        order = np.lexsort((ids, -scores[found]))[:top_k]
        return ids[order], scores[found][order]

    def scores(self, vector: BowVector) -> NDArray[np.float64]:
        """(P,) score of every place, in the order of `place_ids`."""
        return self._file.scores(vector.word_ids, vector.weights)


# Trained on simulated warehouses by `tests/benchmarks/survey/default_vocabulary.py`, which reproduces the same bytes.
DEFAULT_VOCABULARY_SHA256 = "be3518d36889c1d59cb5bf33b41e573d064585376a11c75990fa0accfa1e8a47"
_FILE = "vocabulary.fmvb"


@lru_cache(maxsize=1)
def default_vocabulary_bytes() -> bytes:
    """Bytes of the installed file."""
    return (resources.files("fleetmap") / "data" / _FILE).read_bytes()


@lru_cache(maxsize=1)
def default_vocabulary() -> Vocabulary:
    """The vocabulary that ships with fleetmap, decoded. Maps refer to it by hash instead of carrying it."""
    return decode_vocabulary(default_vocabulary_bytes())


def shipped_vocabulary(sha256: str) -> bytes | None:
    """Bytes of the shipped vocabulary if it has this hash, else None."""
    return default_vocabulary_bytes() if sha256 == DEFAULT_VOCABULARY_SHA256 else None
