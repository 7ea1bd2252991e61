"""The inverted file against dense vectors, and retrieval of places seen again."""

import numpy as np
import pytest

from fleetmap.bow.place_index import PlaceIndex
from fleetmap.bow.vocabulary import BowVector
from support.worlds.vocabulary_training import train_vocabulary

WORDS = 300


def _vector(rng: np.random.Generator, length: int) -> BowVector:
    word_ids = np.sort(rng.choice(WORDS, length, replace=False)).astype(np.int32)
    weights = rng.random(length)
    return BowVector(word_ids, (weights / max(weights.sum(), 1e-9)).astype(np.float32))


def _dense(vector: BowVector) -> np.ndarray:
    dense = np.zeros(WORDS)
    dense[vector.word_ids] = vector.weights
    return dense


@pytest.fixture(scope="module")
def places() -> list[BowVector]:
    rng = np.random.default_rng(0)
    return [_vector(rng, int(rng.integers(0, 60))) for _ in range(260)]


@pytest.mark.parametrize("count", [0, 1, 64, 65, 260])
def test_scores_are_those_of_dense_vectors(places: list[BowVector], count: int) -> None:
    index = PlaceIndex(WORDS)
    for place in range(count):
        index.add(1000 - 3 * place, places[place])
    query = _vector(np.random.default_rng(1), 40)
    wanted = np.array([1.0 - 0.5 * np.abs(_dense(query) - _dense(p)).sum() if len(p) else 0.0 for p in places[:count]])
    np.testing.assert_allclose(index.scores(query), wanted, atol=1e-6)
    ids, scores = index.query(query, None, top_k=7)
    assert len(ids) == min(7, int((wanted > 1e-9).sum()))
    assert (np.diff(scores) <= 0).all()
    np.testing.assert_allclose(scores, np.sort(wanted)[::-1][: len(ids)], atol=1e-6)
    np.testing.assert_allclose(wanted[(1000 - ids) // 3], scores, atol=1e-6)


def test_ties_go_to_the_lower_id_and_the_mask_is_kept(places: list[BowVector]) -> None:
    index = PlaceIndex(WORDS)
    for place_id in (9, 4, 7, 2):
        index.add(place_id, places[5])
    ids, scores = index.query(places[5], None, top_k=3)
    assert ids.tolist() == [2, 4, 7]
    np.testing.assert_allclose(scores, 1.0, atol=1e-6)
    ids, _ = index.query(places[5], np.array([True, False, True, False]), top_k=3)
    assert ids.tolist() == [7, 9]
    assert len(index.query(places[5], np.zeros(4, bool))[0]) == 0
    assert len(index.query(BowVector(np.zeros(0, np.int32), np.zeros(0, np.float32)))[0]) == 0


def test_an_id_is_added_once(places: list[BowVector]) -> None:
    index = PlaceIndex(WORDS)
    index.add(3, places[1])
    with pytest.raises(AssertionError):
        index.add(3, places[2])


def test_a_noisy_second_look_finds_its_place() -> None:
    """40 places of 120 features; seen again with 8 % of bits flipped and a third of the features exchanged."""
    rng = np.random.default_rng(4)
    looks = rng.integers(0, 256, (40, 120, 32), dtype=np.uint8)
    images = np.repeat(np.arange(40), 120)
    vocabulary = train_vocabulary(looks.reshape(-1, 32), 10, 3, rng, images)
    index = PlaceIndex(vocabulary.word_count)
    for place, look in enumerate(looks):
        index.add(place, vocabulary.bow_vector(vocabulary.words(look)))
    for place, look in enumerate(looks):
        again = look[:80] ^ np.packbits(rng.random((80, 256)) < 0.08, axis=1)
        again = np.concatenate([again, rng.integers(0, 256, (40, 32), dtype=np.uint8)])
        ids, scores = index.query(vocabulary.bow_vector(vocabulary.words(again)), None, top_k=2)
        assert ids[0] == place
        assert scores[0] > 1.2 * scores[1]
