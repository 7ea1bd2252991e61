"""The budget: kept where it must be, the choice against a plain greedy loop, and what it is chosen by."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fleetmap import core
from fleetmap.geometry import Array, se3_exp
from fleetmap.mapformat.tile import encode_tile
from mapserver.survey.settings import BudgetSettings
from mapserver.survey.survey_map import SurveyMap, history_of
from mapserver.tiles import tiling as module
from mapserver.tiles.tiling import choose_landmarks, covered_path_m, distinctive_landmarks, tiles_from_survey
from support.storage.map_samples import observed, random_survey


def exactly(count: int, tile_landmarks: int = 1 << 30) -> BudgetSettings:
    """What the views need, whatever it looks like: random descriptors have no twin."""
    return BudgetSettings(
        landmarks_per_m=0.0, min_landmarks=count, tile_landmarks=tile_landmarks, view_distinctive_landmarks=0
    )


def plain_greedy(
    bins: list[list[int]], weights: np.ndarray, cells: np.ndarray, room: list[int], limit: int, needs: list[int]
) -> set[int]:
    """The best one next, all values computed anew each time. Four bins are a view."""
    needs = list(needs)
    counts: dict[int, int] = {}
    chosen: list[int] = []
    room = list(room)
    while len(chosen) < limit:
        gains = {
            n: weights[n] * sum(1.0 / (1.0 + counts.get(b, 0)) for b in bins[n] if needs[b // 4] > 0)
            for n in range(len(bins))
            if n not in chosen and room[cells[n]] > 0
        }
        if not gains or max(gains.values()) == 0:
            break
        best = max(gains, key=lambda n: (gains[n], -n))
        chosen.append(best)
        room[cells[best]] -= 1
        for b in bins[best]:
            counts[b] = counts.get(b, 0) + 1
            needs[b // 4] -= 1
    return set(chosen)


@pytest.mark.parametrize("needs", [[99, 99, 99], [9, 2, 30], [1, 0, 3]])
@pytest.mark.parametrize("seed", range(4))
def test_the_lazy_choice_is_the_plain_one(seed: int, needs: list[int]) -> None:
    rng = np.random.default_rng(seed)
    bins = [rng.integers(0, 12, rng.integers(1, 6)).tolist() for _ in range(40)]
    weights = rng.choice([0.5, 1.0, 1.5], 40)  # many ties
    cells, room = rng.integers(0, 3, 40), np.array([5, 30, 4])
    expected = plain_greedy(bins, weights, cells, room.tolist(), 20, needs)
    starts = np.concatenate([[0], np.cumsum([len(b) for b in bins])]).astype(np.int64)
    chosen = np.zeros(40, bool)
    taken = core.choose_landmarks(
        np.arange(40), starts, np.concatenate(bins).astype(np.int64), weights, cells.astype(np.int64),
        room.astype(np.int64), 20, np.zeros(12, np.int64), chosen, np.array(needs), 4,
    )  # fmt: skip
    assert taken == len(expected)
    assert set(np.flatnonzero(chosen)) == expected


def seen_per_view(survey: SurveyMap, chosen: np.ndarray) -> np.ndarray:
    return np.bincount(survey.obs_keyframe[chosen[survey.obs_landmark]], minlength=len(survey.map_from_body))


def with_a_lonely_view(own: np.ndarray) -> SurveyMap:
    """Keyframe 9 of ten sees some of 400 landmarks that nobody else sees, and nothing else."""
    survey = random_survey(np.random.default_rng(2), keyframes=10, landmarks=400)
    other = ~np.isin(survey.obs_landmark, own) & (survey.obs_keyframe != 9)
    count = len(own)
    return replace(
        survey,
        obs_keyframe=np.append(survey.obs_keyframe[other], np.full(count, 9)).astype(np.int32),
        obs_landmark=np.append(survey.obs_landmark[other], own).astype(np.int32),
        obs_pixels=np.concatenate([survey.obs_pixels[other], survey.obs_pixels[:count]]),
        obs_octave=np.append(survey.obs_octave[other], np.zeros(count, np.int8)),
        obs_sigma_px=np.append(survey.obs_sigma_px[other], np.ones(count)),
    )


def test_a_lonely_view_is_served_before_crowded_ones_get_more() -> None:
    own = np.arange(375, 400)
    survey = with_a_lonely_view(own)
    chosen = choose_landmarks(survey, exactly(120))
    # All others are seen several times: by how often they are seen alone, none of these would be kept.
    assert np.bincount(survey.obs_landmark)[np.isin(np.arange(400), own)].max() == 1
    assert seen_per_view(survey, chosen)[9] >= 5


def test_a_view_at_the_end_of_a_drive_keeps_what_it_needs() -> None:
    """Its own landmarks are seen from nowhere else, so that any other one helps many views at once."""
    survey = with_a_lonely_view(np.arange(300, 400))
    served = choose_landmarks(survey, msgspec.structs.replace(exactly(160), view_landmarks=40))
    unserved = choose_landmarks(survey, msgspec.structs.replace(exactly(160), view_landmarks=0))
    assert served.sum() == unserved.sum() == 160
    assert seen_per_view(survey, served)[9] >= 40 > seen_per_view(survey, unserved)[9]
    assert seen_per_view(survey, served).min() >= 40


def test_every_view_gets_what_tells_it_from_its_twins_first() -> None:
    """A tenth of the landmarks look like no other; by their worth hardly any would be chosen, for they are seen once."""
    rng = np.random.default_rng(9)
    survey = random_survey(rng, keyframes=20, landmarks=800)
    pairs = np.repeat(rng.integers(0, 256, (360, 32), dtype=np.uint8), 2, axis=0)
    points = survey.points_map.copy()
    points[1:720:2] = points[:720:2] + np.array([30.0, 0.0, 0.05])
    survey = replace(survey, descriptors=np.concatenate([pairs, survey.descriptors[720:]]), points_map=points)
    is_alone = distinctive_landmarks(survey.points_map, survey.descriptors)
    np.testing.assert_array_equal(np.flatnonzero(is_alone), np.arange(720, 800))
    once = np.isin(survey.obs_landmark, np.arange(720)) | (np.diff(survey.obs_landmark, prepend=-1) != 0)
    survey = observed(survey, once)
    wanted = seen_per_view(survey, is_alone)
    told = choose_landmarks(survey, msgspec.structs.replace(exactly(200), view_distinctive_landmarks=60))
    untold = choose_landmarks(survey, exactly(200))
    assert told.sum() == untold.sum() == 200
    np.testing.assert_array_equal(seen_per_view(survey, told & is_alone), wanted)
    assert (seen_per_view(survey, untold & is_alone) < wanted).mean() > 0.5
    some = choose_landmarks(survey, msgspec.structs.replace(exactly(200), view_distinctive_landmarks=1))
    assert (some & is_alone).sum() < is_alone.sum()


def test_the_path_sets_the_budget_and_breaks_do_not_count() -> None:
    survey = random_survey(np.random.default_rng(3), keyframes=50, landmarks=500)
    whole_m = np.linalg.norm(np.diff((survey.map_from_body @ survey.body_from_cam)[:, :3, 3], axis=0), axis=1).sum()
    assert covered_path_m(survey) == pytest.approx(whole_m)
    settings = BudgetSettings(landmarks_per_m=2.0, min_landmarks=10)
    assert choose_landmarks(survey, settings).sum() == int(2.0 * whole_m)
    broken = survey.map_from_body.copy()
    broken[25:, 0, 3] += 1000.0
    assert whole_m - 5 < covered_path_m(replace(survey, map_from_body=broken)) < whole_m


def test_the_same_way_again_adds_no_budget_and_the_way_back_does() -> None:
    survey = random_survey(np.random.default_rng(3), keyframes=50)
    once_m = covered_path_m(survey)
    twice = np.concatenate([survey.map_from_body, survey.map_from_body + 0.1 * np.eye(4)[:, 3] * [[1], [1], [0], [0]]])
    assert covered_path_m(replace(survey, map_from_body=twice)) == pytest.approx(once_m, abs=5.0)
    turned = survey.map_from_body[::-1] @ np.diag([-1.0, -1.0, 1.0, 1.0])
    tilt = se3_exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))  # the camera looks along x, and back
    there_and_back = np.concatenate([survey.map_from_body, turned]) @ tilt
    assert covered_path_m(replace(survey, map_from_body=there_and_back, body_from_cam=np.eye(4))) > 1.8 * once_m


def test_what_later_surveys_found_again_comes_before_what_they_missed() -> None:
    """The nights looked twenty times for every landmark, and found every second one seldom."""
    survey = random_survey(np.random.default_rng(8), keyframes=20, landmarks=600)
    first = choose_landmarks(survey, exactly(150))
    is_often = np.arange(600) % 2 == 0
    looks = np.full(600, 20, np.uint32)
    seen = np.where(is_often, 16, 1).astype(np.uint32)
    known = replace(history_of(survey), landmark_expected=looks, landmark_seen=seen)
    later = choose_landmarks(replace(survey, history=known), exactly(150))
    assert first.sum() == later.sum() == 150
    assert (first & is_often).sum() < 90
    assert (later & is_often).sum() > 110
    alike = replace(known, landmark_seen=looks // 2)  # says nothing of one against another
    assert (choose_landmarks(replace(survey, history=alike), exactly(150)) & first).sum() > 100


def test_what_is_published_is_kept_first() -> None:
    survey = random_survey(np.random.default_rng(4), keyframes=20, landmarks=600)
    ids = survey.landmark_ids
    worst = ids[~choose_landmarks(survey, exactly(500))][:60]
    again = choose_landmarks(survey, exactly(100), published=worst)
    seen = ids[np.unique(survey.obs_landmark)]
    assert set(ids[again]) >= set(worst) & set(seen)
    assert again.sum() == 100
    # Nothing else changed, so nothing changes.
    np.testing.assert_array_equal(choose_landmarks(survey, exactly(100), published=ids[again]), again)


def test_tiles_stay_below_their_limit() -> None:
    survey = random_survey(np.random.default_rng(5), keyframes=10, landmarks=900)
    chosen = choose_landmarks(survey, exactly(800, tile_landmarks=70))
    assert max(len(tile) for tile in tiles_from_survey(survey, chosen=chosen)) == 70


def test_a_full_tile_of_the_default_budget_fits_in_256_kb() -> None:
    """Random descriptors and places that see 300 landmarks each: harder to compress than any real tile."""
    rng = np.random.default_rng(6)
    settings = BudgetSettings()
    survey = random_survey(rng, keyframes=60, landmarks=settings.tile_landmarks + 500)
    map_from_body = survey.map_from_body.copy()
    map_from_body[:, :2, 3] = rng.uniform(1, 15, (60, 2))
    survey = replace(
        survey,
        points_map=rng.uniform([0, 0, 0], [16, 16, 8], (len(survey.points_map), 3)),
        landmark_ids=np.sort(rng.choice(1 << 20, len(survey.landmark_ids), replace=False)).astype(np.uint32),
        map_from_body=map_from_body,
    )
    chosen = choose_landmarks(survey, exactly(10_000, settings.tile_landmarks))
    largest = max(tiles_from_survey(survey, chosen=chosen), key=len)
    assert len(largest) == settings.tile_landmarks
    assert len(encode_tile(largest)) <= 256_000


def test_nothing_comes_of_nothing() -> None:
    nobody = observed(random_survey(np.random.default_rng(7)), np.arange(0))
    assert not choose_landmarks(nobody, BudgetSettings()).any()


# What looks like nothing else, against all pairs; and what a part of them finds.


def racks(rng: np.random.Generator, aisles: int, count: int, noise: float) -> tuple[Array, np.ndarray]:
    """The same things in every aisle, 5 m apart, each bit of them wrong that often."""
    points = rng.uniform(0.0, 4.0, (count, 3))
    bits = rng.integers(0, 2, (count, 256))
    shifts = np.array([[0.0, 5.0 * aisle, 0.0] for aisle in range(aisles)])
    all_points = [points + shift + rng.normal(0.0, 0.02, points.shape) for shift in shifts]
    all_bits = [bits ^ (rng.random(bits.shape) < noise) for _ in range(aisles)]
    return np.concatenate(all_points), np.packbits(np.concatenate(all_bits).astype(np.uint8), axis=1)


@pytest.mark.parametrize("noise", [0.0, 0.06, 0.12])
def test_as_all_pairs_say(noise: float) -> None:
    rng = np.random.default_rng(2)
    points, descriptors = racks(rng, 3, 60, noise)
    points = np.concatenate([points, rng.uniform(0.0, 15.0, (30, 3))])
    descriptors = np.concatenate([descriptors, rng.integers(0, 256, (30, 32), dtype=np.uint8)])
    # The same thing mapped twice is one thing, and what stands on another shelf is no twin.
    points[-1], descriptors[-1] = points[-2] + [0.5, 0.0, 0.0], descriptors[-2]
    points[-3], descriptors[-3] = points[-4] + [5.0, 0.0, 0.4], descriptors[-4]
    found = distinctive_landmarks(points, descriptors)
    bits = np.unpackbits(descriptors, axis=1).astype(int)
    apart = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=2) > 2.0
    level = np.abs(points[:, None, 2] - points[None, :, 2]) <= 0.15
    alike = (bits[:, None, :] != bits[None, :, :]).sum(axis=2) <= 60
    np.testing.assert_array_equal(found, ~(apart & level & alike).any(axis=1))
    assert found[-30:].all()
    assert found[:180].mean() < 0.3


def test_a_part_of_the_others_finds_what_repeats_often(monkeypatch) -> None:
    points, descriptors = racks(np.random.default_rng(3), 30, 40, 0.05)
    monkeypatch.setattr(module, "_REACH", 0)
    monkeypatch.setattr(module, "_MOST_COMPARED", 20)
    assert distinctive_landmarks(points, descriptors).mean() < 0.05


def test_an_empty_survey_has_none() -> None:
    assert distinctive_landmarks(np.zeros((0, 3)), np.zeros((0, 32), np.uint8)).shape == (0,)
