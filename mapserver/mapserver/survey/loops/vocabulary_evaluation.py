"""Evaluation of a site's own vocabulary against the given one, measured on revisits."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import PlaceIndex, Vocabulary, train_vocabulary
from mapserver.survey.keyframes.connected_components import shared_landmarks
from mapserver.survey.settings import VocabularySettings
from mapserver.survey.survey_map import SurveyMap

MIN_SHARED, MIN_REVISITS = 30, 20
_CHANCE = 0.05  # of a verdict for own words that are no better
Descriptors = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class VocabularyEvaluation:
    """Revisits looked up with both vocabularies: how often the most similar place was right, and what follows.

    Own words are better only where chance alone would hardly say so (sign test over the revisits on which the two differ).
    """

    revisits: int
    given_right: int
    own_right: int
    own_is_better: bool


def try_own_vocabulary(
    survey_map: SurveyMap,
    descriptors: Sequence[Descriptors],
    given: Vocabulary,
    settings: VocabularySettings,
    gap: int,
    seed: int,
) -> tuple[VocabularyEvaluation, Vocabulary | None]:
    """The trial, and the site's own vocabulary, of all keyframes, where it is better.

    descriptors: those of each keyframe (K). A revisit is a keyframe that shares landmarks with one at least `gap` before it; own
    words are trained without the revisits that judge them. With fewer than 20 there is no trial.
    """
    right = _revisits(survey_map, gap)
    if len(right) < MIN_REVISITS:
        return VocabularyEvaluation(len(right), 0, 0, own_is_better=False), None
    others = [k for k in range(len(descriptors)) if k not in right]
    own = train_on(descriptors, others, settings, seed)
    found = [_found(vocabulary, descriptors, right, gap) for vocabulary in (given, own)]
    only_own = sum(mine and not theirs for theirs, mine in zip(*found, strict=True))
    only_given = sum(theirs and not mine for theirs, mine in zip(*found, strict=True))
    is_better = sign_test(only_own, only_own + only_given) < _CHANCE
    trial = VocabularyEvaluation(len(right), sum(found[0]), sum(found[1]), is_better)
    return trial, train_on(descriptors, range(len(descriptors)), settings, seed) if is_better else None


def train_on(
    descriptors: Sequence[Descriptors], pictures: Sequence[int], settings: VocabularySettings, seed: int
) -> Vocabulary:
    """A vocabulary of some pictures' descriptors, at most `max_descriptors` of them, drawn at random."""
    rows = np.concatenate([descriptors[k] for k in pictures])
    images = np.repeat(np.arange(len(pictures)), [len(descriptors[k]) for k in pictures])
    rng = np.random.default_rng(seed)
    if len(rows) > settings.max_descriptors:
        chosen = np.sort(rng.choice(len(rows), settings.max_descriptors, replace=False))
        rows, images = rows[chosen], images[chosen]
    return train_vocabulary(rows, settings.branching, settings.levels, rng, images)


def sign_test(wins: int, of: int) -> float:
    """Chance of at least so many wins of `of` fair coins."""
    return float(sum(comb(of, k) for k in range(wins, of + 1)) / 2**of)


def _revisits(survey_map: SurveyMap, gap: int) -> dict[int, set[int]]:
    """For each keyframe that sees an older place again: which those are."""
    found: dict[int, set[int]] = {}
    for j, i in zip(*shared_landmarks(survey_map, MIN_SHARED), strict=True):
        if i - j >= gap:
            found.setdefault(int(i), set()).add(int(j))
    return found


def _found(
    vocabulary: Vocabulary, descriptors: Sequence[Descriptors], right: dict[int, set[int]], gap: int
) -> list[bool]:
    """Whether the most similar keyframe, at least `gap` before each revisit, is one of the right ones."""
    vectors = [vocabulary.bow_vector(vocabulary.words(rows)) for rows in descriptors]
    index = PlaceIndex(vocabulary.word_count)
    for k, vector in enumerate(vectors):
        index.add(k, vector)
    found = []
    for i, places in right.items():
        ids, _ = index.query(vectors[i], np.arange(len(vectors)) <= i - gap, 1)
        found.append(bool(len(ids)) and int(ids[0]) in places)
    return found
