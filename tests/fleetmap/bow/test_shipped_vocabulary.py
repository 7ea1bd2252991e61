"""The vocabulary that ships: it is what its hash says, has words for every picture, and is not asked for."""

from hashlib import sha256

import numpy as np

from fleetmap.bow.shipped_vocabulary import (
    DEFAULT_VOCABULARY_SHA256,
    default_vocabulary,
    default_vocabulary_bytes,
    shipped_vocabulary,
)
from fleetmap.bow.vocabulary import encode_vocabulary


def test_it_is_what_its_hash_says() -> None:
    assert sha256(default_vocabulary_bytes()).hexdigest() == DEFAULT_VOCABULARY_SHA256
    assert encode_vocabulary(default_vocabulary()) == default_vocabulary_bytes()
    assert shipped_vocabulary(DEFAULT_VOCABULARY_SHA256) == default_vocabulary_bytes()
    assert shipped_vocabulary("0" * 64) is None


def test_its_words_are_many_and_all_weighed() -> None:
    """Small enough for a git repository and for every robot."""
    vocabulary = default_vocabulary()
    assert vocabulary.word_count == 10_000
    assert np.isfinite(vocabulary.idf).all()
    assert (vocabulary.idf > 0).all()
    assert len(default_vocabulary_bytes()) < 1_500_000


def test_near_descriptors_share_words_and_others_do_not() -> None:
    rng = np.random.default_rng(0)
    vocabulary = default_vocabulary()
    some = (
        rng.choice(vocabulary.centres[vocabulary.child_count == 0], 500, replace=False).view(np.uint8).reshape(-1, 32)
    )
    flipped = some.copy()
    for row in flipped:
        for bit in rng.choice(256, 8, replace=False):
            row[bit // 8] ^= np.uint8(1 << (bit % 8))
    others = rng.integers(0, 256, some.shape, dtype=np.uint8)
    words = vocabulary.words(some)
    assert (vocabulary.words(flipped) == words).mean() > 0.5
    assert (vocabulary.words(others) == words).mean() < 0.02
