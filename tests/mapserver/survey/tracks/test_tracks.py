"""Landmarks from pairs: no keyframe twice in one, observed to a fraction of a pixel."""

from dataclasses import replace
from functools import lru_cache
from itertools import combinations, pairwise

import numpy as np

from fleetmap.geometry import Array, se3_inverse, so3_exp, transform_points
from fleetmap.sensors.rectification import Rectifier
from mapserver.survey.executor import SERIAL
from mapserver.survey.rig import rig_of
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Keyframe, Landmarks, RigImages, image_numbers
from mapserver.survey.tracks.pairs import MatchInputs, PairMatch, PredictedMotion, match_pair
from mapserver.survey.tracks.tracks import Tracks, build_landmarks, refine_observations, tracks_of
from support.worlds.box_room import out_and_back, points_seen, rendered_keyframes


def pair(i: int, j: int, features: list[tuple[int, int]]) -> PairMatch:
    return PairMatch(i, j, np.array(features, np.int32).reshape(-1, 2), np.eye(4), np.eye(6))


def groups(pairs: list[PairMatch], known: Tracks | None = None) -> list[list[tuple[int, int]]]:
    """The tracks of some pairs, (keyframe, feature) of each member."""
    found = tracks_of(pairs, known)
    members = list(zip(found.images.tolist(), found.features.tolist(), strict=True))
    return [members[start:end] for start, end in pairwise([*found.starts.tolist(), len(members)])]


def test_a_chain_of_matches_is_one_track_and_a_contradiction_is_left_out() -> None:
    """0:1-1:5-2:7 hang together; the weaker pair 0-2 says 0:9-2:7, which would bring keyframe 0 in twice."""
    strong = [pair(0, 1, [(1, 5), (2, 6)]), pair(1, 2, [(5, 7), (6, 8)])]
    found = groups([pair(0, 2, [(9, 7)]), *strong])
    assert sorted(found) == [[(0, 1), (1, 5), (2, 7)], [(0, 2), (1, 6), (2, 8)]]
    assert groups([]) == []


def test_what_is_known_comes_first_and_pairs_go_on_from_it() -> None:
    """Known are 0:1-1:5-2:7 and 0:3-2:4: a pair adds keyframe 3 to one, and cannot join them, as keyframe 2 has both."""
    known = Tracks(np.array([0, 1, 2, 0, 2]), np.array([1, 5, 7, 3, 4]), np.array([0, 3]))
    found = groups([pair(2, 3, [(7, 8)]), pair(1, 2, [(5, 4), (9, 2)])], known)
    assert sorted(found) == [[(0, 1), (1, 5), (2, 7), (3, 8)], [(0, 3), (2, 4)], [(1, 9), (2, 2)]]
    assert sorted(groups([], known)) == [[(0, 1), (1, 5), (2, 7)], [(0, 3), (2, 4)]]
    again = tracks_of([], Tracks.of(views()[3], image_numbers(4, 1)))
    assert len(again.starts) == len(views()[3].points_map)


def test_no_keyframe_is_twice_in_a_track_and_the_order_of_pairs_does_not_matter() -> None:
    """Random matches among few features, so that conflicts abound."""
    rng = np.random.default_rng(3)
    pairs = [
        pair(i, i + d, list(zip(rng.permutation(20)[:9], rng.permutation(20)[:9], strict=True)))
        for i in range(5)
        for d in (1, 2)
    ]
    expected = groups(pairs)
    assert all(len({k for k, _ in group}) == len(group) > 1 for group in expected)
    nodes = [node for group in expected for node in group]
    assert len(set(nodes)) == len(nodes)
    for _ in range(3):
        assert groups([pairs[k] for k in rng.permutation(len(pairs))]) == expected


def test_observations_go_and_landmarks_that_are_seen_too_rarely_with_them() -> None:
    landmark = np.array([0, 0, 0, 1, 1, 2, 2], np.int32)
    marks = Landmarks(
        np.arange(9.0).reshape(3, 3), np.array([0, 1, 2, 0, 1, 1, 2], np.int32), np.arange(3, 10, dtype=np.int32), landmark,
        np.arange(7, dtype=np.int32),
        np.arange(21.0).reshape(7, 3), np.ones((7, 2)),
    )  # fmt: skip
    left = marks.keep_observations(np.array([1, 1, 0, 1, 0, 1, 1], bool), 2)
    np.testing.assert_array_equal(left.points_map, marks.points_map[[0, 2]])
    np.testing.assert_array_equal(left.obs_landmark, [0, 0, 1, 1])
    np.testing.assert_array_equal(left.obs_feature, [0, 1, 5, 6])
    np.testing.assert_array_equal(left.obs_keyframe, [0, 1, 1, 2])
    np.testing.assert_array_equal(left.obs_camera, [3, 4, 8, 9])


@lru_cache(maxsize=1)
def views() -> tuple[list[Keyframe], Array, Rectifier, Landmarks]:
    """Keyframes of the room from four true places, and the landmarks that they share."""
    settings = SurveySettings()
    map_from_body = np.array([out_and_back(6.0)(t) for t in (2.0, 2.3, 2.6, 2.9)])
    keyframes, rectifier = rendered_keyframes(map_from_body, settings)
    map_from_cam, inputs = (
        map_from_body @ rectifier.body_from_cam,
        MatchInputs(keyframes, rectifier.camera, settings.pairs),
    )
    pairs = [
        match_pair(i, j, inputs, PredictedMotion(se3_inverse(map_from_cam[j]) @ map_from_cam[i], 0.02))
        for i, j in combinations(range(4), 2)
    ]
    posed = RigImages.of(keyframes, map_from_body, rig_of(rectifier))
    return keyframes, map_from_body, rectifier, build_landmarks(posed, tracks_of(pairs), settings)


def true_pixels() -> tuple[Array, Array]:
    """(M, 3) where each observation of a landmark should be, given its reference's pixel; (M,) which are references."""
    _, map_from_body, rectifier, marks = views()
    map_from_cam = map_from_body @ rectifier.body_from_cam
    is_reference = np.r_[True, np.diff(marks.obs_landmark) > 0]
    row = np.flatnonzero(is_reference)[marks.obs_landmark]
    expected = np.empty((len(row), 3))
    for k in range(4):
        for source in range(4):
            rows = np.flatnonzero((marks.obs_keyframe == k) & (marks.obs_keyframe[row] == source))
            points = points_seen(map_from_cam[source], marks.obs_pixels[row[rows], :2])
            expected[rows] = rectifier.camera.pixel_from_point(transform_points(se3_inverse(map_from_cam[k]), points))
    return expected, is_reference


def test_observations_are_good_to_a_fraction_of_a_pixel() -> None:
    """Against the room's geometry; ORB's own coordinates, which are whole pixels of an octave, are far behind."""
    keyframes, _, _, marks = views()
    assert len(marks.points_map) > 300
    expected, is_reference = true_pixels()
    matched = ~is_reference
    refined = np.linalg.norm(marks.obs_pixels[matched, :2] - expected[matched, :2], axis=1)
    features = zip(marks.obs_keyframe[matched], marks.obs_feature[matched], strict=True)
    whole = np.array([keyframes[k].features.pixels[f] for k, f in features])
    unrefined = np.linalg.norm(whole - expected[matched, :2], axis=1)
    assert np.median(refined) < 0.15
    assert np.median(refined) < 0.3 * np.median(unrefined)
    assert (refined < 1.0).mean() > 0.95


def test_disparities_are_good_to_a_fraction_of_a_pixel_and_not_biased() -> None:
    _, _, _, marks = views()
    expected, _ = true_pixels()
    known = np.isfinite(marks.obs_pixels[:, 2])
    assert known.mean() > 0.9
    own = (marks.obs_pixels[:, 0] - marks.obs_pixels[:, 2])[known]
    error = own - (expected[:, 0] - expected[:, 2])[known]
    assert np.median(np.abs(error)) < 0.1
    assert abs(np.median(error)) < 0.02


def test_sigmas_tell_refined_observations_from_others() -> None:
    """Normalised by their own sigmas, errors are those of a believable noise: neither far too small nor too large."""
    _, _, _, marks = views()
    expected, is_reference = true_pixels()
    normal = ((marks.obs_pixels[:, :2] - expected[:, :2]) / marks.obs_sigma_px[:, :1])[~is_reference]
    assert np.median(np.abs(normal)) < 0.7
    assert (np.abs(normal) < 4).mean() > 0.97
    assert (marks.obs_sigma_px > 0).all()


def test_only_what_better_poses_warp_otherwise_is_observed_anew() -> None:
    """Coordinates are spoiled: those of landmarks that the turned keyframe sees are found again, the others are not touched."""
    keyframes, map_from_body, rectifier, marks = views()
    posed = RigImages.of(keyframes, map_from_body, rig_of(rectifier))
    spoiled = replace(marks, obs_pixels=marks.obs_pixels + 5.0)
    same = refine_observations(posed, spoiled, SurveySettings(), SERIAL, posed.map_from_cam)
    np.testing.assert_array_equal(same.obs_pixels, spoiled.obs_pixels)
    before = posed.map_from_cam.copy()
    before[3, :3, :3] = before[3, :3, :3] @ so3_exp(np.array([0.0, 0.05, 0.0]))
    found = refine_observations(posed, spoiled, SurveySettings(), SERIAL, before)
    anew = np.isin(marks.obs_landmark, marks.obs_landmark[marks.obs_keyframe == 3])
    assert 0.1 < anew.mean() < 0.99
    np.testing.assert_allclose(found.obs_pixels[anew], marks.obs_pixels[anew], atol=1e-9)
    np.testing.assert_array_equal(found.obs_pixels[~anew], spoiled.obs_pixels[~anew])


def test_spare_keyframes_observe_and_define_nothing() -> None:
    """Keyframes 0 and 3 are spare: references are in 1 and 2, both of which see every landmark, and 0 and 3 are seen to see them."""
    keyframes, map_from_body, rectifier, marks = views()
    order = np.lexsort((marks.obs_keyframe, marks.obs_landmark))
    starts = np.flatnonzero(np.diff(marks.obs_landmark, prepend=-1))
    tracks = Tracks(marks.obs_keyframe[order].astype(np.int64), marks.obs_feature[order].astype(np.int64), starts)
    spare = np.array([True, False, False, True])
    posed = RigImages.of(keyframes, map_from_body, rig_of(rectifier))
    left = build_landmarks(posed, tracks, SurveySettings(), redundant=spare)
    assert not spare[left.obs_keyframe[np.flatnonzero(np.diff(left.obs_landmark, prepend=-1))]].any()
    members = np.bincount(marks.obs_landmark[~spare[marks.obs_keyframe]], minlength=len(marks.points_map))
    assert 100 < len(left.points_map) <= (members > 1).sum() < len(marks.points_map)
    assert (np.bincount(left.obs_landmark[~spare[left.obs_keyframe]]) == 2).all()
    assert np.bincount(left.obs_keyframe, minlength=4)[[0, 3]].min() > 50
    nearest = np.linalg.norm(left.points_map[:, None] - marks.points_map, axis=2).min(axis=1)
    assert np.median(nearest) < 0.02
