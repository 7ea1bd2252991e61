"""Own words are taken where revisits say so for sure, and only there."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary, train_vocabulary
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.loops.vocabulary_evaluation import sign_test, try_own_vocabulary
from mapserver.survey.settings import VocabularySettings
from mapserver.survey.survey_map import SurveyMap

PLACES, FEATURES = 40, 60


def looks(rng: np.random.Generator) -> list[NDArray[np.uint8]]:
    """Every place twice, the second time with a tenth of the bits changed; all descriptors of a place differ."""
    first = [rng.integers(0, 256, (FEATURES, 32), dtype=np.uint8) for _ in range(PLACES)]
    again = [rows ^ np.packbits(rng.random((FEATURES, 256)) < 0.1, axis=1) for rows in first]
    return first + again


def there_and_again() -> SurveyMap:
    """Keyframe k and k + PLACES see the same landmarks."""
    keyframe = np.concatenate([np.repeat(np.arange(PLACES), FEATURES), np.repeat(np.arange(PLACES) + PLACES, FEATURES)])
    landmark = np.tile(np.arange(PLACES * FEATURES), 2)
    order = np.lexsort((keyframe, landmark))
    count, seen = PLACES * FEATURES, len(keyframe)
    stamps = np.arange(2 * PLACES, dtype=np.int64)
    places = np.tile(np.eye(4), (2 * PLACES, 1, 1))
    return SurveyMap(
        StereoCamera(200.0, 160.0, 120.0, 0.1, 320, 240), np.eye(4), stamps, places, np.arange(count, dtype=np.uint32),
        np.zeros((count, 3)), np.zeros((count, 32), np.uint8), np.ones(count), keyframe[order].astype(np.int32),
        landmark[order].astype(np.int32), np.zeros((seen, 3)), np.zeros(seen, np.int8), np.ones(seen),
        Trajectory(stamps, places), np.ones(2 * PLACES, bool), np.zeros((count, 5, 5), np.uint8),
    )  # fmt: skip


def one_word() -> Vocabulary:
    """For which all places look alike."""
    return train_vocabulary(np.zeros((0, 32), np.uint8), 8, 2, np.random.default_rng(0))


def test_own_words_replace_useless_ones() -> None:
    descriptors = looks(np.random.default_rng(1))
    trial, own = try_own_vocabulary(there_and_again(), descriptors, one_word(), VocabularySettings(), 8, 0)
    assert trial.revisits == PLACES
    assert trial.own_right > 0.8 * PLACES > trial.given_right
    assert trial.own_is_better
    assert own is not None
    assert own.word_count > 500


def test_words_that_do_as_well_stay() -> None:
    descriptors = looks(np.random.default_rng(1))
    _, good = try_own_vocabulary(there_and_again(), descriptors, one_word(), VocabularySettings(), 8, 0)
    assert good is not None
    trial, own = try_own_vocabulary(there_and_again(), descriptors, good, VocabularySettings(), 8, 0)
    assert not trial.own_is_better
    assert own is None


def test_few_revisits_decide_nothing() -> None:
    few = there_and_again()
    seen = few.obs_landmark < 10 * FEATURES
    few = replace(few, obs_keyframe=few.obs_keyframe[seen], obs_landmark=few.obs_landmark[seen])
    descriptors = looks(np.random.default_rng(1))
    trial, own = try_own_vocabulary(few, descriptors, one_word(), VocabularySettings(), 8, 0)
    assert (trial.revisits, trial.own_is_better, own) == (10, False, None)


@pytest.mark.parametrize(("wins", "of", "chance"), [(0, 0, 1.0), (5, 5, 1 / 32), (4, 5, 6 / 32)])
def test_sign_test(wins: int, of: int, chance: float) -> None:
    assert sign_test(wins, of) == pytest.approx(chance)
