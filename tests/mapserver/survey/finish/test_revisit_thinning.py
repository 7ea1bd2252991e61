"""Visits beyond enough take no part in the adjustment, and are placed as well as if they had."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import se3_exp
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import bundle_rounds
from mapserver.survey.finish.revisit_thinning import adjust_visits, redundant_keyframes, without_redundant
from mapserver.survey.rig import Rig
from mapserver.survey.settings import BundleSettings, CullSettings, SurveySettings
from mapserver.survey.state import Landmarks, RigImages
from mapserver.survey.tracks.tracks import Tracks
from support.worlds.bundle_scene import make_scene
from support.worlds.corridor_scene import BODY_FROM_CAM, CAMERA, Scene, plain_keyframes, scene

FEATURES = 60


def redundant(tracks: Tracks, octaves: list[int], settings: SurveySettings) -> np.ndarray:
    """As told of keyframes of one camera with these octaves."""
    places = np.tile(np.eye(4), (len(octaves), 1, 1))
    rig = Rig.of_one(CAMERA, BODY_FROM_CAM)
    return redundant_keyframes(tracks, RigImages.of(plain_keyframes(octaves, FEATURES), places, rig), settings)


def tracks_seen_by(who: list[list[int]]) -> Tracks:
    """Tracks of these keyframes; each keyframe's features are numbered as its tracks come."""
    flat = np.array([k for members in who for k in members], np.int64)
    counts = np.zeros(flat.max() + 1, np.int64)
    features = np.empty_like(flat)
    for n, k in enumerate(flat):
        features[n] = counts[k]
        counts[k] += 1
    return Tracks(flat, features, np.cumsum([0, *(len(members) for members in who)])[:-1])


def drive(laps: int, places: int, per_place: int = 20) -> Tracks:
    """Laps past some places; what stands at a place is seen from it and from the next two."""

    def who(place: int) -> list[int]:
        return sorted(lap * places + (place + ahead) % places for lap in range(laps) for ahead in range(3))

    return tracks_seen_by([who(place) for place in range(places) for _ in range(per_place)])


def test_of_many_laps_the_first_ones_are_left() -> None:
    spare = redundant(drive(6, 30), [0] * 180, SurveySettings())
    np.testing.assert_array_equal(np.flatnonzero(spare), np.arange(90, 180))
    more = SurveySettings(cull=CullSettings(repeated_visits=4))
    np.testing.assert_array_equal(np.flatnonzero(redundant(drive(6, 30), [0] * 180, more)), np.arange(120, 180))


@pytest.mark.parametrize("laps", [1, 2, 3])
def test_a_drive_that_comes_back_twice_at_most_keeps_all(laps: int) -> None:
    assert not redundant(drive(laps, 30), [0] * 30 * laps, SurveySettings()).any()


def test_a_keyframe_that_sees_more_than_the_others_is_not_spare() -> None:
    """The last lap looks from nearer (an octave that is finer by two), or at things that it alone sees twice."""
    nearer = [3] * 120 + [1] * 30
    assert not redundant(drive(5, 30), nearer, SurveySettings())[120:].any()
    old = drive(5, 30, per_place=10)
    own = [[120 + k, 121 + k] for k in range(0, 28, 2) for _ in range(15)]
    members = [g.tolist() for g in np.split(old.images, old.starts[1:])]
    spare = redundant(tracks_seen_by([*members, *own]), [0] * 150, SurveySettings())
    assert not spare[120:148].any()
    assert spare[148:].all()  # these two see nothing of their own


def test_blind_keyframes_among_spare_ones_are_spare_too() -> None:
    """In the fourth lap 95 to 97 see nothing, and nobody else does where no keyframe is spare: in the first lap they stay."""
    whole = drive(4, 30)
    members = [g.tolist() for g in np.split(whole.images, whole.starts[1:])]
    dark = {3, 4, 5, 95, 96, 97}
    spare = redundant(
        tracks_seen_by([seen for m in members if (seen := [k for k in m if k not in dark])]), [0] * 120,
        SurveySettings(),
    )  # fmt: skip
    assert spare[95:98].all()
    assert not spare[:90].any()


def test_held_points_stay_and_keyframes_find_their_places_among_them() -> None:
    truth = make_scene(keyframes=6, landmarks=150, step_s=0.4, seed=1).problem
    moved = truth.map_from_body.copy()
    for k in range(1, 6):
        moved[k] = moved[k] @ se3_exp(np.array([0.01, -0.02, 0.01, 0.05, -0.03, 0.02]) * k / 5)
    problem = replace(truth, map_from_body=moved, points_held=True)
    for dense in (1500, 0):
        result = optimize(
            problem, BundleSettings(max_iterations=30, relative_cost_tolerance=1e-12, dense_unknowns=dense)
        )
        np.testing.assert_array_equal(result.points_map, truth.points_map)
        np.testing.assert_allclose(result.map_from_body, truth.map_from_body, atol=1e-8)


def laps_of(given: Scene, laps: int, seed: int) -> tuple[Scene, np.ndarray]:
    """The same drive again and again, observed anew; which keyframes (K,) are of later laps than the third."""
    rng, state, count = np.random.default_rng(seed), given.state, len(given.map_from_body)
    marks = state.landmarks
    observed = np.tile(marks.obs_landmark, laps)
    order = np.argsort(observed, kind="stable")
    noise = rng.normal(0, 0.2, (len(observed), 3))
    noise[: len(marks.obs_landmark)] = 0.0
    keyframe = np.concatenate([marks.obs_keyframe + lap * count for lap in range(laps)]).astype(np.int32)
    landmarks = Landmarks(
        marks.points_map, keyframe[order], np.zeros_like(keyframe), observed[order], np.arange(len(observed))[order],
        (np.tile(marks.obs_pixels, (laps, 1)) + noise)[order], np.tile(marks.obs_sigma_px, (laps, 1))[order],
    )  # fmt: skip
    guessed = np.tile(state.map_from_body, (laps, 1, 1))
    motion = replace(state.motion, motions=np.zeros((laps * count, 9)))
    whole = replace(
        state, stamps_ns=np.arange(laps * count, dtype=np.int64) * 100_000_000, map_from_body=guessed, motion=motion,
        landmarks=landmarks,
    )  # fmt: skip
    spare = np.arange(laps * count) >= 3 * count
    return Scene(
        whole, np.tile(given.map_from_body, (laps, 1, 1)), given.points_map, np.tile(given.is_outlier, laps)
    ), spare


def test_spare_keyframes_are_placed_as_well_as_if_they_had_been_adjusted() -> None:
    given, spare = laps_of(scene(12, 3, drift=0.01, outliers=0.03), 5, 4)
    every, _ = laps_of(scene(12, 3, drift=0.01, outliers=0.03), 5, 4)
    every.state = bundle_rounds(every.state, SurveySettings(), final=True)
    given.state = adjust_visits(given.state, SurveySettings(), spare, rounds=3)
    errors = [
        np.linalg.norm(s.state.map_from_body[:, :3, 3] - s.map_from_body[:, :3, 3], axis=1) for s in (given, every)
    ]
    assert errors[0][spare].max() < 0.01
    assert np.median(errors[0][spare]) < 1.5 * np.median(errors[1][spare])
    marks = given.state.landmarks
    assert (np.diff(marks.obs_landmark) >= 0).all()
    assert 0.9 < spare[marks.obs_keyframe].mean() / spare.mean() < 1.1
    wild = given.is_outlier[marks.obs_feature]  # features are numbered by row
    assert wild.mean() < 0.002
    assert given.is_outlier.mean() > 0.02


def test_what_is_not_spare_is_adjusted_as_if_the_rest_were_not_there() -> None:
    given, spare = laps_of(scene(12, 5, drift=0.01), 4, 6)
    alone = bundle_rounds(without_redundant(given.state, spare), SurveySettings(), final=True)
    given.state = adjust_visits(given.state, SurveySettings(), spare, rounds=3)
    np.testing.assert_array_equal(given.state.map_from_body[~spare], alone.map_from_body)
    np.testing.assert_array_equal(given.state.landmarks.points_map, alone.landmarks.points_map)


def test_the_imu_does_not_carry_over_what_is_left_out() -> None:
    """Keyframes a tenth of a second apart: over one that is spare it does, over fifty it does not."""
    given, _ = laps_of(scene(12, 7, drift=0.01), 8, 8)
    spare = np.zeros(96, bool)
    spare[[5, *range(20, 70)]] = True
    goes_on = without_redundant(given.state, spare).motion.goes_on
    np.testing.assert_array_equal(np.flatnonzero(~goes_on), [19])  # the first keyframe after the gap
