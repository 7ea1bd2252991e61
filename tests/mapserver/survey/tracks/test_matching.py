"""Which keyframes are matched with which, and how far a match may be from what odometry says."""

import pickle
from functools import lru_cache
from typing import Any

import numpy as np

from fleetmap.geometry import Array, se3, se3_exp, so3_exp
from fleetmap.sensors.rectification import Rectifier
from mapserver.survey.executor import SERIAL, SerialExecutor
from mapserver.survey.rig import rig_of
from mapserver.survey.settings import PairSettings, SurveySettings
from mapserver.survey.state import Keyframe, RigImages
from mapserver.survey.tracks.matching import NearPlaces, PairFinder, fixed_allowance_m
from mapserver.survey.tracks.pairs import PairTask, view_overlap
from support.worlds.box_room import out_and_back, rendered_keyframes

SETTINGS = SurveySettings(pairs=PairSettings(previous=2, covisible=3))


@lru_cache(maxsize=1)
def seen() -> tuple[list[Keyframe], Array, Rectifier]:
    """Ten keyframes along the wall and back, and where each truly was."""
    places = np.array([out_and_back(6.0)(t) for t in np.linspace(1.0, 5.0, 10)])
    keyframes, rectifier = rendered_keyframes(places, SETTINGS)
    return keyframes, places, rectifier


def finder(places: Array) -> PairFinder:
    keyframes, _, rectifier = seen()
    return PairFinder(RigImages.of(keyframes, places, rig_of(rectifier)), SETTINGS.pairs)


def test_candidates_are_the_last_few_and_those_that_see_the_same() -> None:
    _, places, _ = seen()
    found = finder(places).candidates()
    assert len(set(found)) == len(found)
    assert all(i < j for i, j in found)
    for j in range(1, 10):
        of_j = {i for i, k in found if k == j}
        assert set(range(max(0, j - 2), j)) <= of_j
        assert len(of_j) <= 2 + 3
    assert (0, 9) in found  # back where it began


def test_before_loops_are_closed_only_near_ones_are_candidates() -> None:
    _, places, _ = seen()
    found = finder(places).candidates(only_near=4)
    assert max(j - i for i, j in found) <= 4
    assert {(j - 1, j) for j in range(1, 10)} <= set(found)


def test_places_that_look_away_are_no_candidates() -> None:
    """The second half of the ride is turned round: nothing of the first can be seen from there."""
    _, places, _ = seen()
    turned = places.copy()
    turned[5:, :3, :3] = so3_exp(np.array([0, 0, np.pi])) @ places[5:, :3, :3]
    found = finder(turned).candidates()
    assert {(i, j) for i, j in found if i < 5 <= j} == {(3, 5), (4, 5), (4, 6)}


def matches(predicted_places: Array, allowed_m: float, sigma_rad: float | None = 0.02) -> set[tuple[int, int]]:
    found = finder(predicted_places).match([(3, 4), (4, 5), (0, 9)], lambda i, j: allowed_m, sigma_rad)
    return {(m.i, m.j) for m in found}


def test_matches_that_agree_with_the_prediction_are_kept() -> None:
    _, places, _ = seen()
    assert matches(places, 0.05) == {(3, 4), (4, 5), (0, 9)}
    assert matches(places, 0.05, None) == {(3, 4), (4, 5), (0, 9)}


def test_matches_that_contradict_the_prediction_are_dropped() -> None:
    """Keyframe 9 is believed 0.4 m away from where it was; then turned by 15 degrees."""
    _, places, _ = seen()
    off = places.copy()
    off[9, :3, 3] += [0.4, 0, 0]
    assert matches(off, 0.3) == {(3, 4), (4, 5)}
    assert matches(off, 0.5) == {(3, 4), (4, 5), (0, 9)}
    turned = places.copy()
    turned[9] = turned[9] @ se3_exp(np.array([0, 0, np.radians(15), 0, 0, 0]))
    assert matches(turned, 9.0, None) == {(3, 4), (4, 5)}


def test_depth_and_overlap_against_the_room() -> None:
    """The wall is 2.2-2.6 m ahead; the same view overlaps itself wholly, one from behind not at all."""
    keyframes, _, rectifier = seen()
    assert 1.8 < keyframes[0].median_depth_m < 3.0
    assert view_overlap(keyframes[0], rectifier.camera, np.eye(4)) > 0.99
    behind = se3(so3_exp(np.array([0, np.pi, 0])), np.zeros(3))
    assert view_overlap(keyframes[0], rectifier.camera, behind) == 0.0
    aside = se3(so3_exp(np.array([0, np.radians(38.6), 0])), np.zeros(3))  # half of the picture's angle
    assert 0.2 < view_overlap(keyframes[0], rectifier.camera, aside) < 0.6


def test_near_places_hold_all_that_reach_each_other() -> None:
    rng = np.random.default_rng(4)
    positions, reach = rng.uniform(0.0, 80.0, (400, 3)), rng.uniform(4.0, 9.0, 400)
    reach[::23] *= 5.0  # wider than the cells that are looked at
    around = NearPlaces(positions, reach)
    looked = 0
    for j in range(1, 400):
        until = max(j - 6, 0)
        found = around.before(j, until)
        apart = np.linalg.norm(positions[:until] - positions[j], axis=1)
        assert np.isin(np.flatnonzero(apart < np.maximum(reach[:until], reach[j])), found).all()
        assert (np.diff(found) > 0).all() and (found < until).all()
        looked += len(found)
    assert looked < 0.6 * 400 * 399 / 2


def test_what_is_looked_at_does_not_grow_with_the_site() -> None:
    """A drive of twice the length at the same density, where every fifth keyframe looks far: as many around each."""
    rng, looked = np.random.default_rng(5), []
    for count in (1000, 2000):
        positions = np.column_stack([0.5 * np.arange(count), rng.uniform(0.0, 20.0, count), np.zeros(count)])
        around = NearPlaces(positions, np.where(np.arange(count) % 5, 4.0, 30.0))
        looked.append(np.mean([len(around.before(j, j)) for j in range(count)]))
    assert looked[1] < 1.1 * looked[0]
    assert looked[1] > 15.0


class _Watched(SerialExecutor):
    """Keeps what would travel to a process."""

    def __init__(self) -> None:
        self.shared: list[Any] = []
        self.tasks: list[PairTask] = []

    def map(self, function: Any, shared: Any, batches: Any) -> Any:
        self.shared.append(shared)
        for batch in batches:
            self.tasks.append(batch)
            yield function(pickle.loads(pickle.dumps(shared)), pickle.loads(pickle.dumps(batch)))


def test_a_process_gets_the_keyframes_of_its_pairs_alone() -> None:
    keyframes, places, rectifier = seen()
    posed = RigImages.of(keyframes, places, rig_of(rectifier))
    watched, pairs = _Watched(), [(0, 1), (1, 2), (7, 8)]
    allowed_m = fixed_allowance_m(places)
    found = [
        PairFinder(posed, SETTINGS.pairs, executor).match(pairs, allowed_m, 0.02) for executor in (SERIAL, watched)
    ]
    assert len(found[0]) == len(found[1]) > 0
    for own, other in zip(*found, strict=True):
        assert np.array_equal(own.features, other.features)
        assert np.array_equal(own.j_from_i, other.j_from_i)
    assert [len(shared.keyframes) for shared in watched.shared] == [0]
    assert [sorted(task.keyframes) for task in watched.tasks] == [[0, 1, 2, 7, 8]]
