"""A survey that went blind: what is joined, what is left out, and what is said about it."""

from types import SimpleNamespace

import numpy as np
import pytest

from fleetmap.errors import SurveyError
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import ImuSamples
from mapserver.survey.loops.connected_components import (
    SigmaBetween,
    between_kept,
    find_components,
    grown_sigma,
    only_kept,
)
from mapserver.survey.loops.loops import Loops
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.rig import Rig
from mapserver.survey.state import KeyframeMotion, OdometryPass, RelativeTerm, SurveyState
from support.worlds.corridor_scene import plain_marks

PER_KEYFRAME = 40
Ends, Span = list[tuple[int, int]], tuple[float, int]


def survey(seen: list[range], loops: Ends | None = None) -> SurveyState:
    """Keyframes at 1 Hz; every keyframe sees a range of landmarks, loops share 20 more."""
    pairs = [(k, n) for k, numbers in enumerate(seen) for n in numbers]
    count = max((n for _, n in pairs), default=-1) + 1
    for a, b in loops or []:
        pairs += [(k, count + n) for k in (a, b) for n in range(20)]
        count += 20
    pairs.sort(key=lambda pair: (pair[1], pair[0]))
    places = np.tile(np.eye(4), (len(seen), 1, 1))
    places[:, 0, 3] = np.arange(len(seen))
    points = np.column_stack([np.arange(count), np.zeros(count), np.zeros(count)]).astype(float)
    each = np.column_stack([np.arange(len(seen))] * 3).astype(float)
    return SurveyState(
        np.arange(len(seen), dtype=np.int64) * 1_000_000_000, places,
        Rig.of_one(StereoCamera(200.0, 160.0, 120.0, 0.1, 320, 240), np.eye(4)),
        KeyframeMotion(
            False, ImuSamples.empty(), None, 0.0, np.tile(each, 3),
            [RelativeTerm(k, k + 1, np.eye(4), np.eye(6)) for k in range(len(seen) - 1)],
        ),
        plain_marks(pairs, points),
    )  # fmt: skip


def guessed(state: SurveyState) -> OdometryPass:
    """Its odometry: every other frame is a keyframe."""
    keyframes = [SimpleNamespace(frame_index=2 * k) for k in range(len(state.stamps_ns))]
    return OdometryPass([], np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), np.zeros(0), keyframes, inertial=False)


def chain(first: int, keyframes: int) -> list[range]:
    """Neighbours share half of what they see."""
    return [range(first + k * PER_KEYFRAME // 2, first + (k + 2) * PER_KEYFRAME // 2) for k in range(keyframes)]


def sigmas(grows_m: list[float]) -> SigmaBetween:
    """Odometry that adds so much, root of summed squares, from each keyframe to the next."""
    return grown_sigma(np.concatenate([[0.0], np.cumsum(np.square(grows_m))]))


BLIND = [range(0), range(0)]


def test_an_unbroken_survey_stays_as_it_is() -> None:
    whole = survey(chain(0, 6))
    found = find_components(whole, sigmas([9.0] * 5), 0.1)
    assert only_kept(whole, guessed(whole), Loops(), found.kept)[0] is whole


@pytest.mark.parametrize(
    ("seen", "grows_m", "loops", "parts", "stray"),
    [
        (chain(0, 6), [9.0] * 5, [], [(5.0, 6, True)], []),
        (chain(0, 4) + BLIND + chain(1000, 6), [0.01] * 3 + [0.05] * 3 + [0.01] * 5, [], [(11.0, 12, True)], []),
        # 0.04 m is within the joining sigma of 0.1 m, three times that is not.
        (
            chain(0, 8) + BLIND + chain(1000, 4), [0.01] * 7 + [0.02, 0.05, 5.0] + [0.01] * 3, [],
            [(8.0, 9, True), (13.0, 4, False)], [(9.0, 1)],
        ),
        # The largest part is the one with most that see.
        (
            chain(0, 4) + BLIND * 3 + chain(1000, 3), [0.01] * 3 + [5.0] + [0.001] * 8, [],
            [(3.0, 4, True), (12.0, 9, False)], [],
        ),
        # A bridge is as long as the darkness: each step alone would be sure enough.
        (
            chain(0, 4) + BLIND * 5 + chain(1000, 6), [0.01] * 3 + [0.05] * 11 + [0.01] * 5, [],
            [(3.0, 4, False), (19.0, 6, True)], [(13.0, 10)],
        ),
        (
            chain(0, 4) + BLIND + chain(1000, 6), [0.01] * 3 + [5.0] * 3 + [0.01] * 5, [(1, 9)],
            [(11.0, 10, True)], [(5.0, 2)],
        ),
    ],
    ids=["unbroken", "a blink", "a way into the dark", "many blind", "a long darkness", "a loop"],
)  # fmt: skip
def test_parts_are_joined_by_pictures_loops_and_sure_odometry(
    seen: list[range], grows_m: list[float], loops: Ends, parts: list[tuple[float, int, bool]], stray: list[Span]
) -> None:
    found = find_components(survey(seen, loops), sigmas(grows_m), 0.1)
    assert [(p.end_s, p.keyframes, p.kept) for p in found.components] == parts
    assert [(p.end_s, p.keyframes) for p in found.stray] == stray


def test_what_lies_beyond_a_long_darkness_is_left_out_and_named() -> None:
    dark = survey(chain(0, 4) + BLIND + chain(1000, 6))
    found = find_components(dark, sigmas([0.01] * 3 + [5.0] * 3 + [0.01] * 5), 0.1)
    assert [(p.start_s, p.end_s, p.kept) for p in found.components] == [(0.0, 3.0, False), (6.0, 11.0, True)]
    assert [(p.start_s, p.end_s, p.kept) for p in found.stray] == [(4.0, 5.0, False)]
    assert "left out: 4 keyframes from 0.0 to 3.0 s" in found.components[0].remark()
    edges = [PoseEdge(0, 3, np.eye(4), np.eye(6), is_loop=True), PoseEdge(6, 9, np.eye(4), np.eye(6), is_loop=True)]
    kept, guess, loops = only_kept(dark, guessed(dark), Loops(edges=edges), found.kept)
    assert len(kept.stamps_ns) == len(kept.map_from_body) == len(kept.motion.motions) == 6
    assert kept.stamps_ns[0] == 6_000_000_000
    np.testing.assert_array_equal(kept.motion.motions[:, 3], np.arange(6, 12))
    assert [(r.i, r.j) for r in kept.motion.relative] == [(k, k + 1) for k in range(5)]
    assert [(e.i, e.j) for e in loops.edges] == [(0, 3)]
    assert [k.frame_index for k in guess.keyframes] == list(range(12, 24, 2))
    assert kept.landmarks.points_map[:, 0].min() >= 1000
    assert (np.bincount(kept.landmarks.obs_landmark) >= 2).all()
    assert set(kept.landmarks.obs_keyframe.tolist()) == set(range(6))
    np.testing.assert_array_equal(between_kept(23, np.arange(0, 23, 2), found.kept), np.arange(23) >= 12)


def test_nothing_that_hangs_together_is_refused() -> None:
    with pytest.raises(SurveyError, match="none of 3 keyframes"):
        find_components(survey([range(0, 40), range(100, 140), range(200, 240)]), sigmas([1.0, 1.0]), 0.1)
