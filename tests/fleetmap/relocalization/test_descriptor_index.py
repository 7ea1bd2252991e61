"""What a picture shows of a map is found although no descriptor is twice the same."""

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.features.matching import packed
from fleetmap.relocalization.map_view import DescriptorIndex
from support.worlds.vocabulary_training import changed, train_vocabulary

Descriptors = NDArray[np.uint8]


def distances(a: Descriptors, b: Descriptors) -> NDArray[np.int64]:
    """(A, B) bits that differ, by numpy alone."""
    return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2, dtype=np.int64)


def vocabulary(descriptors: Descriptors, branching: int = 10, levels: int = 4) -> Vocabulary:
    return train_vocabulary(descriptors, branching, levels, np.random.default_rng(0))


@pytest.mark.parametrize("count", [1, 4, 7, 9])
def test_the_nearest_cells_are_those_of_a_sort(count: int) -> None:
    rng = np.random.default_rng(count)
    centres, asked = rng.integers(0, 256, (7, 32), np.uint8), rng.integers(0, 256, (50, 32), np.uint8)
    order = np.argsort(distances(asked, centres), axis=1, kind="stable")[:, :count]
    expected = np.pad(order, ((0, 0), (0, max(0, count - 7))), constant_values=-1)
    np.testing.assert_array_equal(core.nearest_cells(packed(asked), packed(centres), count), expected)


def test_where_all_cells_are_asked_nothing_is_missed() -> None:
    rng = np.random.default_rng(1)
    held = rng.integers(0, 256, (400, 32), np.uint8)
    index = DescriptorIndex(held, vocabulary(held, branching=2))  # two levels of two: four cells
    asked = changed(held[::3], 30, rng)
    for bits in (29, 30, 110):
        np.testing.assert_array_equal(index.near(asked, bits), (distances(asked, held) <= bits).any(axis=0))
    assert not index.near(asked[:0], 256).any()


def test_descriptors_of_another_day_are_found_and_no_others() -> None:
    """A tenth of the bits of each differ: their words mostly do."""
    rng = np.random.default_rng(2)
    held = rng.integers(0, 256, (5000, 32), np.uint8)
    words = vocabulary(held)
    shown, asked = np.arange(0, 5000, 5), changed(held[::5], 25, rng)
    found = DescriptorIndex(held, words).near(asked, 40)
    assert found[shown].mean() > 0.8
    assert np.mean(words.words(asked) == words.words(held[shown])) < 0.6
    assert not np.delete(found, shown).any(), "descriptors that are drawn anew differ by a hundred bits"


def test_a_vocabulary_of_one_word_is_one_cell() -> None:
    held = np.random.default_rng(3).integers(0, 256, (20, 32), np.uint8)
    single = train_vocabulary(held[:0], 10, 4, np.random.default_rng(0))
    assert DescriptorIndex(held, single).near(held[4:6], 0).nonzero()[0].tolist() == [4, 5]
    assert len(DescriptorIndex(held[:0], single).near(held, 256)) == 0
