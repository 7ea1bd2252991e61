"""A survey that went blind: what is joined, what is left out, and what is said about it."""

import numpy as np
import pytest

from fleetmap.errors import SurveyError
from fleetmap.rectification import StereoCamera
from fleetmap.samples import Trajectory
from mapserver.survey.parts import SigmaBetween, find_parts, only_kept
from mapserver.survey.result import SurveyMap

PER_KEYFRAME = 40


def survey(seen: list[range], loops: list[tuple[int, int]] | None = None) -> SurveyMap:
    """Keyframes at 1 Hz with a frame between each; every keyframe sees a range of landmarks, loops share 20 more."""
    pairs = [(k, n) for k, numbers in enumerate(seen) for n in numbers]
    count = max((n for _, n in pairs), default=-1) + 1
    for a, b in loops or []:
        pairs += [(k, count + n) for k in (a, b) for n in range(20)]
        count += 20
    pairs.sort(key=lambda pair: (pair[1], pair[0]))
    keyframe, landmark = np.array(pairs, np.int32).reshape(-1, 2).T
    stamps = np.arange(2 * len(seen) - 1, dtype=np.int64) * 500_000_000
    places = np.tile(np.eye(4), (len(stamps), 1, 1))
    places[:, 0, 3] = np.arange(len(stamps))
    points = np.column_stack([np.arange(count), np.zeros(count), np.zeros(count)]).astype(float)
    return SurveyMap(
        StereoCamera(200.0, 160.0, 120.0, 0.1, 320, 240), np.eye(4), stamps[::2], places[::2],
        np.arange(count, dtype=np.uint32), points, np.zeros((count, 32), np.uint8), np.ones(count), keyframe, landmark,
        np.zeros((len(pairs), 3)), np.zeros(len(pairs), np.int8), np.ones(len(pairs)), Trajectory(stamps, places),
        np.ones(len(stamps), bool), np.zeros((count, 5, 5), np.uint8),
    )  # fmt: skip


def chain(first: int, keyframes: int) -> list[range]:
    """Neighbours share half of what they see."""
    return [range(first + k * PER_KEYFRAME // 2, first + (k + 2) * PER_KEYFRAME // 2) for k in range(keyframes)]


def sigmas(grows_m: list[float]) -> SigmaBetween:
    """Odometry that adds so much, root of summed squares, from each keyframe to the next."""
    variances = np.concatenate([[0.0], np.cumsum(np.square(grows_m))])
    covariances = np.zeros((len(variances), 6, 6))
    covariances[:, 3, 3] = variances
    return SigmaBetween(covariances)


BLIND = [range(0), range(0)]


def test_an_unbroken_survey_is_one_part_and_stays_as_it_is() -> None:
    whole = survey(chain(0, 6))
    parts = find_parts(whole, sigmas([9.0] * 5), 0.1)
    assert [(p.kept, p.keyframes) for p in parts.parts] == [(True, 6)]
    assert not parts.stray
    assert only_kept(whole, np.arange(0, 11, 2), parts.kept) is whole


def test_what_lies_beyond_a_long_darkness_is_left_out_and_named() -> None:
    dark = survey(chain(0, 4) + BLIND + chain(1000, 6))
    parts = find_parts(dark, sigmas([0.01] * 3 + [5.0] * 3 + [0.01] * 5), 0.1)
    assert [(p.start_s, p.end_s, p.kept) for p in parts.parts] == [(0.0, 3.0, False), (6.0, 11.0, True)]
    assert [(p.start_s, p.end_s, p.kept) for p in parts.stray] == [(4.0, 5.0, False)]
    assert "left out: 4 keyframes from 0.0 to 3.0 s" in parts.parts[0].remark()
    kept = only_kept(dark, np.arange(0, 23, 2), parts.kept)
    assert len(kept.keyframe_stamps_ns) == len(kept.map_from_body) == 6
    assert kept.keyframe_stamps_ns[0] == 6_000_000_000
    np.testing.assert_array_equal(kept.landmark_ids, np.arange(len(kept.points_map)))
    assert kept.points_map[:, 0].min() >= 1000
    assert (np.bincount(kept.obs_landmark) >= 2).all()
    assert set(kept.obs_keyframe.tolist()) == set(range(6))
    np.testing.assert_array_equal(kept.trajectory_estimated, np.arange(23) >= 12)


def test_a_blink_is_bridged_by_odometry_and_takes_the_blind_along() -> None:
    blink = survey(chain(0, 4) + BLIND + chain(1000, 6))
    parts = find_parts(blink, sigmas([0.01] * 3 + [0.05] * 3 + [0.01] * 5), 0.1)
    assert [(p.kept, p.keyframes) for p in parts.parts] == [(True, 12)]
    assert not parts.stray


def test_a_bridge_is_as_long_as_the_darkness_not_as_its_steps() -> None:
    """Each step alone would be sure enough."""
    dark = survey(chain(0, 4) + BLIND * 5 + chain(1000, 6))
    parts = find_parts(dark, sigmas([0.01] * 3 + [0.05] * 11 + [0.01] * 5), 0.1)
    assert [p.kept for p in parts.parts] == [False, True]


def test_a_loop_joins_what_darkness_parted() -> None:
    dark = survey(chain(0, 4) + BLIND + chain(1000, 6), loops=[(1, 9)])
    parts = find_parts(dark, sigmas([0.01] * 3 + [5.0] * 3 + [0.01] * 5), 0.1)
    assert [(p.kept, p.keyframes) for p in parts.parts] == [(True, 10)]
    assert [p.keyframes for p in parts.stray] == [2]


def test_nothing_that_hangs_together_is_refused() -> None:
    with pytest.raises(SurveyError, match="none of 3 keyframes"):
        find_parts(survey([range(0, 40), range(100, 140), range(200, 240)]), sigmas([1.0, 1.0]), 0.1)
