"""Landmarks through surveys: what moved is told from noise, what is missed fades as its own history says."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mapserver.survey.merge.landmark_persistence import LandmarkCounts, count_landmarks, faded, missed_since, shifts
from mapserver.survey.settings import SessionSettings, SurveySettings
from mapserver.survey.survey_map import History, SurveyMap
from support.worlds.session_scene import session_scene


def base(expected: int, seen: int, missed: int) -> SurveyMap:
    """Six keyframes, and landmarks that all have the same past."""
    numbers = (np.full(300, n, np.uint32) for n in (expected, seen, missed))
    history = History(np.arange(6, dtype=np.uint32), np.ones(6, bool), *numbers, 6, 300)
    return session_scene(1, landmarks=300, history=history).base


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_noise_moves_nothing_and_what_moved_is_found(seed: int) -> None:
    """Every tenth landmark stands 8 cm aside: those that are seen often enough are found there, hardly any other is."""
    scene = session_scene(seed, landmarks=900)
    points = scene.base.points_map.copy()
    still = shifts(scene.base, scene.map_from_cam, scene.sightings(points, seed), SurveySettings())
    assert len(still.rows) > 100
    assert still.significant.mean() < 0.01
    moved = np.arange(len(points)) % 10 == 0
    points[moved] += [0.05, 0.05, 0.04]
    found = shifts(scene.base, scene.map_from_cam, scene.sightings(points, seed), SurveySettings())
    is_moved = moved[found.rows]
    assert found.significant[is_moved].mean() > 0.8
    assert found.significant[~is_moved].mean() < 0.01
    off_m = np.linalg.norm(found.points_map - points[found.rows], axis=1)[is_moved & found.significant]
    assert np.median(off_m) < 0.03


def test_a_landmark_fades_when_its_misses_are_too_unlikely() -> None:
    """Of a landmark that was seen in every second look, n misses happen with probability (1 - 0.7 * 0.5)^n."""
    known = base(1000, 500, 0)
    n = len(known.points_map)
    limit = int(np.ceil(np.log(0.001) / np.log(1 - 0.7 * 0.5)))
    settings = SurveySettings(sessions=SessionSettings(fade_probability=0.001, look_weight=0.7))
    for misses, gone in ((1, False), (limit - 1, False), (limit + 1, True)):
        counts = LandmarkCounts(np.full(n, misses), np.zeros(n, np.int64))
        assert (faded(known, counts, settings) == gone).all(), misses


def test_one_sighting_brings_a_landmark_back() -> None:
    known = base(40, 20, 14)
    n = len(known.points_map)
    seen = LandmarkCounts(np.full(n, 10), np.r_[np.ones(n // 2, np.int64), np.zeros(n - n // 2, np.int64)])
    missed = missed_since(known, seen)
    assert (missed[: n // 2] == 0).all()
    assert (missed[n // 2 :] == 24).all()
    gone = faded(known, seen, SurveySettings())
    assert not gone[: n // 2].any()
    assert gone[n // 2 :].all()


def test_a_landmark_that_is_hardly_ever_seen_may_be_missed_longer() -> None:
    often, rarely = base(100, 60, 0), base(100, 6, 0)
    n = len(often.points_map)
    counts = LandmarkCounts(np.full(n, 16), np.zeros(n, np.int64))
    assert faded(often, counts, SurveySettings()).all()
    assert not faded(rarely, counts, SurveySettings()).any()


def test_two_features_of_a_picture_see_a_landmark_once() -> None:
    """A history counts pictures."""
    scene = session_scene(1)
    once = scene.sightings(scene.base.points_map, 1)
    blank: Any = SimpleNamespace(features=SimpleNamespace(pixels=np.zeros((0, 2))), disparities=np.zeros((0, 2)))
    for seen in (once, once.only(np.repeat(np.arange(len(once.rows)), 2))):
        counts = count_landmarks(scene.base, [blank] * len(seen.located), scene.map_from_cam, seen)
        np.testing.assert_array_equal(counts.seen, np.bincount(once.rows, minlength=len(counts.seen)))
        assert (counts.expected >= counts.seen).all()
