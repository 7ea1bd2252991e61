"""Tiles of a survey against a plain loop over its observations."""

import numpy as np
import pytest

from fleetmap.errors import SurveyError
from mapserver.tiles import tiling
from mapserver.tiles.tiling import tiles_from_survey
from support.storage.map_samples import random_survey


def test_tiles_hold_what_a_plain_loop_finds() -> None:
    survey = random_survey(np.random.default_rng(4))
    tiles = tiles_from_survey(survey)
    cells = [(tile.tile_x, tile.tile_y) for tile in tiles]
    assert cells == sorted(set(cells))
    centres = [(frame @ survey.body_from_cam)[:3, 3] for frame in survey.map_from_body]
    expected_ids, unseen = {}, []
    for row, landmark_id in enumerate(survey.landmark_ids):
        views = [k for k, seen in enumerate(survey.obs_landmark) if seen == row]
        if not views:
            unseen.append(row)
            continue
        point = survey.points_map[row]
        expected_ids[int(landmark_id)] = (int(point[0] // 16), int(point[1] // 16))
        tile = tiles[cells.index(expected_ids[int(landmark_id)])]
        at = tile.landmark_ids.tolist().index(landmark_id)
        offsets = [centres[survey.obs_keyframe[k]] - point for k in views]
        rays = [offset / np.linalg.norm(offset) for offset in offsets]
        mean = np.mean(rays, axis=0) / np.linalg.norm(np.mean(rays, axis=0))
        distances = sorted(
            np.linalg.norm(o) * 1.2 ** int(survey.obs_octave[k]) for o, k in zip(offsets, views, strict=True)
        )
        np.testing.assert_allclose(tile.points_map[at], point)
        np.testing.assert_array_equal(tile.descriptors[at], survey.descriptors[row])
        np.testing.assert_allclose(tile.view_directions_map[at], mean, atol=1e-6)
        np.testing.assert_allclose(
            tile.view_half_angle_rad[at], max(np.arccos(np.clip(r @ mean, -1, 1)) for r in rays), atol=1e-5
        )
        np.testing.assert_allclose(tile.max_distance_m[at], distances[len(distances) // 2], rtol=1e-6)
        np.testing.assert_allclose(tile.sigma_m[at], survey.point_sigma_m[row], rtol=1e-6)
    found = {int(i): (tile.tile_x, tile.tile_y) for tile in tiles for i in tile.landmark_ids}
    assert found == expected_ids
    assert 5 in unseen


def test_places_list_the_best_observed_landmarks(monkeypatch) -> None:
    monkeypatch.setattr(tiling, "MAX_PLACE_LANDMARKS", 10)
    survey = random_survey(np.random.default_rng(5))
    counts = np.bincount(survey.obs_landmark, minlength=len(survey.landmark_ids))
    tiles = tiles_from_survey(survey)
    listed = {}
    for tile in tiles:
        for place, map_from_cam, ids in zip(tile.place_ids, tile.map_from_cam, tile.place_landmark_ids, strict=True):
            np.testing.assert_allclose(map_from_cam, survey.map_from_body[place] @ survey.body_from_cam)
            assert (map_from_cam[:2, 3] // 16).tolist() == [tile.tile_x, tile.tile_y]
            listed[int(place)] = set(ids.tolist())
    assert sorted(listed) == list(range(len(survey.map_from_body)))
    for place, ids in listed.items():
        seen = survey.obs_landmark[survey.obs_keyframe == place]
        count_of = {int(survey.landmark_ids[row]): int(counts[row]) for row in seen}
        assert len(ids) == 10
        assert min(count_of[i] for i in ids) >= max(n for i, n in count_of.items() if i not in ids)


def test_a_landmark_seen_from_opposite_sides_has_the_widest_view() -> None:
    survey = random_survey(np.random.default_rng(7), keyframes=2, landmarks=6)
    centres = (survey.map_from_body @ survey.body_from_cam)[:, :3, 3]
    survey.points_map[:] = centres.mean(axis=0)
    survey.obs_landmark[:] = 0
    survey.obs_keyframe[:] = np.arange(len(survey.obs_keyframe)) % 2
    if len(survey.obs_keyframe) % 2:
        survey.obs_keyframe[-1] = 0
    tile = next(tile for tile in tiles_from_survey(survey) if len(tile))
    assert np.isclose(np.linalg.norm(tile.view_directions_map[0]), 1, atol=1e-6)
    assert tile.view_half_angle_rad[0] > 3.1


def test_a_survey_that_is_not_finite_is_refused() -> None:
    survey = random_survey(np.random.default_rng(8))
    survey.points_map[3, 1] = np.nan
    with pytest.raises(SurveyError, match="1 landmarks and 0 keyframes"):
        tiles_from_survey(survey)
