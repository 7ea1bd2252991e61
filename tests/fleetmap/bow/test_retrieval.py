"""Real pictures: places of a flight recognised in pictures that the index does not hold."""

from functools import lru_cache
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.bow.vocabulary import (
    DEFAULT_VOCABULARY_SHA256,
    BowVector,
    PlaceIndex,
    default_vocabulary,
    default_vocabulary_bytes,
    shipped_vocabulary,
)
from fleetmap.features.extraction import extract
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, rotation_angle_rad, rotation_from_quat_wxyz
from support.recordings.realdata import real_data
from support.worlds.vocabulary_training import changed, encode_vocabulary, train_vocabulary


@lru_cache(maxsize=1)
def _flight(root: Path) -> tuple[list[np.ndarray], Array, list[Array]]:
    """Descriptors, position (N, 3) and rotation of each left picture."""
    rows = [line.split(",") for line in (root / "cam0" / "data.csv").read_text().splitlines()[1:]]
    truth = np.loadtxt(root / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    near = [int(np.argmin(np.abs(truth[:, 0] - int(stamp)))) for stamp, _ in rows]
    pictures = [cv2.imread(str(root / "cam0" / "data" / name.strip()), cv2.IMREAD_GRAYSCALE) for _, name in rows]
    looks = [extract(picture, OrbSettings()).descriptors for picture in pictures]
    return looks, truth[near, 1:4], [rotation_from_quat_wxyz(quat_wxyz) for quat_wxyz in truth[near, 4:8]]


@pytest.mark.parametrize("words", ["own", "shipped"])
def test_pictures_find_their_neighbours(words: str) -> None:
    """Every second picture of V1_01 is in the index, the others are looked up; right is within 1 m and 25 degrees.

    The words that ship were trained on simulated warehouses alone.
    """
    looks, positions, rotations = _flight(real_data("euroc_v101_keyframes") / "mav0")
    held, asked = range(0, len(looks), 2), range(1, len(looks), 2)
    images = np.repeat(np.arange(len(held)), [len(looks[k]) for k in held])
    vocabulary = default_vocabulary()
    if words == "own":
        vocabulary = train_vocabulary(np.concatenate([looks[k] for k in held]), 10, 4, np.random.default_rng(0), images)
    index = PlaceIndex(vocabulary.word_count)
    for k in held:
        index.add(k, vocabulary.bow_vector(vocabulary.words(looks[k])))
    possible = first = among_five = 0
    for k in asked:
        near = [h for h in held if np.linalg.norm(positions[h] - positions[k]) < 1.0]
        neighbours = {h for h in near if np.degrees(rotation_angle_rad(rotations[h].T @ rotations[k])) < 25.0}
        if neighbours:
            found, _ = index.query(vocabulary.bow_vector(vocabulary.words(looks[k])), None, top_k=5)
            possible += 1
            first += int(found[0]) in neighbours
            among_five += not neighbours.isdisjoint(found.tolist())
    assert possible > 40
    assert first >= 0.8 * possible
    assert among_five >= 0.9 * possible


# The vocabulary that ships: it is what its hash says, has words for every picture, and is not asked for.


def test_it_is_what_its_hash_says() -> None:
    assert sha256(default_vocabulary_bytes()).hexdigest() == DEFAULT_VOCABULARY_SHA256
    assert encode_vocabulary(default_vocabulary()) == default_vocabulary_bytes()
    assert shipped_vocabulary(DEFAULT_VOCABULARY_SHA256) == default_vocabulary_bytes()
    assert shipped_vocabulary("0" * 64) is None


def test_its_words_are_many_and_all_weighed() -> None:
    """Small enough for a git repository and for every robot."""
    vocabulary = default_vocabulary()
    assert vocabulary.word_count == 10_000
    assert (np.isfinite(vocabulary.idf) & (vocabulary.idf > 0)).all()
    assert len(default_vocabulary_bytes()) < 1_500_000


def test_near_descriptors_share_words_and_others_do_not() -> None:
    rng = np.random.default_rng(0)
    vocabulary = default_vocabulary()
    leaves = vocabulary.centres[vocabulary.child_count == 0]
    some = rng.choice(leaves, 500, replace=False).view(np.uint8).reshape(-1, 32)
    others = rng.integers(0, 256, some.shape, dtype=np.uint8)
    words = vocabulary.words(some)
    assert (vocabulary.words(changed(some, 8, rng)) == words).mean() > 0.5
    assert (vocabulary.words(others) == words).mean() < 0.02


# The inverted file against dense vectors, and retrieval of places seen again.

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
