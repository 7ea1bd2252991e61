"""Parts of joining: stamps of several recordings on one clock, and keyframes that are enough for what they show."""

from dataclasses import make_dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import se3, se3_inverse
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import ImuSamples, Trajectory
from mapserver.survey.merge import multi_session
from mapserver.survey.merge.base_map import BaseMap, with_baseline
from mapserver.survey.merge.changes import SurveyLimits, fewer_keyframes, known_well
from mapserver.survey.merge.membership import Membership, MembershipVerdict
from mapserver.survey.merge.multi_session import MapMerger, Session, chained
from mapserver.survey.rig import Rig
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import KeyframeMotion, Landmarks, SurveyState
from support.worlds.corridor_scene import plain_marks
from support.worlds.session_scene import session_scene

SECOND_NS = 1_000_000_000


def trajectory(start_s: float, frames: int) -> Trajectory:
    stamps = (np.arange(frames) * SECOND_NS // 10 + int(start_s * SECOND_NS)).astype(np.int64)
    return Trajectory(stamps, np.tile(np.eye(4), (frames, 1, 1)))


def test_recordings_in_order_keep_their_stamps() -> None:
    first, second = trajectory(10, 5), trajectory(100, 7)
    both = chained([first, second], [first, second])
    np.testing.assert_array_equal(both.stamps_ns, np.r_[first.stamps_ns, second.stamps_ns])
    assert len(both) == 12


def test_recordings_that_overlap_follow_each_other_and_their_truth_with_them() -> None:
    first, second = trajectory(10, 50), trajectory(8, 40)
    truths = [trajectory(9, 400), trajectory(7, 300)]
    estimate = chained([first, second], [first, second])
    assert (np.diff(estimate.stamps_ns) > 0).all()
    moved_ns = estimate.stamps_ns[50] - second.stamps_ns[0]
    assert chained(truths, [first, second]).stamps_ns[400] - truths[1].stamps_ns[0] == moved_ns


def test_each_landmark_keeps_enough_keyframes_and_no_more_are_taken() -> None:
    """Ten keyframes see all of thirty landmarks: three of them are enough; a landmark that only one sees keeps that one."""
    seen = [(k, n) for n in range(30) for k in range(10)] + [(10, 30)]
    fewer = fewer_keyframes(plain_marks(seen, np.zeros((31, 3))), 3)
    assert np.bincount(fewer.obs_landmark).tolist() == [3] * 30 + [1]
    assert len(np.unique(fewer.obs_keyframe)) == 4


def test_observations_of_another_baseline_come_back_as_they_were() -> None:
    scene = session_scene(4)
    wide = scene.base.camera.__class__(400.0, 320.0, 240.0, 0.3, 640, 480)
    base = BaseMap(scene.base.map, wide, scene.base.map.body_from_cam)
    row = np.flatnonzero(np.isfinite(scene.base.map.obs_pixels[:, 2]))[0]
    k, n = base.map.obs_keyframe[row], base.map.obs_landmark[row]
    point_cam = se3_inverse(base.map_from_cam[k]) @ np.append(base.points_map[n], 1.0)
    assert np.abs(base.obs_pixels[row] - wide.pixel_from_point(point_cam[None, :3])[0]).max() < 6.0  # noise, times 2.5
    pixels, sigmas = with_baseline(base.obs_pixels, base.obs_sigma_px, 1.0 / base.baseline_ratio)
    np.testing.assert_allclose(pixels, base.map.obs_pixels)
    np.testing.assert_allclose(sigmas, base.map.obs_sigma_px)


def test_a_rig_with_its_body_elsewhere_has_its_cameras_in_the_same_places() -> None:
    scene = session_scene(4)
    other = scene.base.map.body_from_cam @ se3(np.eye(3), np.array([0.3, 0.1, -0.2]))
    base = BaseMap(scene.base.map, scene.base.camera, other)
    np.testing.assert_allclose(base.map_from_body @ other, scene.base.map_from_cam, atol=1e-12)


def test_a_landmark_seen_under_no_angle_is_not_taken_into_a_map() -> None:
    """Two landmarks of a drive along x: one beside it, one so far ahead that all rays to it are parallel, and one never adjusted."""
    places = np.stack([se3(np.eye(3), np.array([0.5 * k, 0.0, 0.0])) for k in range(4)])
    points = np.array([[1.0, 3.0, 0.0], [1.5e6, 0.0, 0.0], [np.nan] * 3])
    keyframes, none = np.tile(np.arange(4, dtype=np.int32), 3), np.zeros(12, np.int32)
    pixels, landmarks = np.full((12, 3), np.nan), np.repeat(np.arange(3, dtype=np.int32), 4)
    marks = Landmarks(points, keyframes, none, landmarks, none, pixels, np.ones((12, 2)))
    camera = StereoCamera(400.0, 320.0, 240.0, 0.12, 640, 480)
    motion = KeyframeMotion(False, ImuSamples.empty(), None, 0.0, np.zeros((4, 9)), [])
    state = SurveyState(np.arange(4), places, Rig.of_one(camera, np.eye(4)), motion, marks)
    survey: Any = SimpleNamespace(state=state)
    joint: Any = SimpleNamespace(own_points_map=points, map_from_body=places)
    assert known_well(survey, joint, SurveySettings()).tolist() == [True, False, False]


class Sites:
    """Stands for `extend`: maps are lists of sessions' letters, and each session needs another one in the map."""

    def __init__(self, needs: dict[str, str]) -> None:
        self.needs, self.tried = needs, ""

    def extend(self, current: Any, session: Any, *_: object) -> Any:
        name = session.survey.name
        self.tried += name
        if self.needs[name] not in current.letters:
            return Membership(f"{name} needs {self.needs[name]}")
        evidence = SimpleNamespace(fixes=3, places=3, cells_seen=9, cells_expected=9)
        grown = made_up_map(current.letters + name)
        return SimpleNamespace(map=grown, measured=None, counts=None, evidence=evidence)


MadeUpMap: Any = make_dataclass("MadeUpMap", ["letters", "trajectory", "trajectory_estimated"])


def made_up_map(letters: str) -> Any:
    return MadeUpMap(letters, trajectory(10.0 * ord(letters[-1]), 4), np.ones(4, bool))


@pytest.mark.parametrize(
    ("sessions", "needs", "tried", "in_map"),
    [
        ("ABcd", {"A": "d", "B": "c", "d": "B"}, "dABdA", "cBdA"),
        ("abcD", {"b": "c", "c": "a", "D": "b"}, "bcDbD", "acbD"),
        ("AB", {"B": "x"}, "B", "A"),
    ],
)
def test_sessions_join_when_what_they_need_is_there(
    sessions: str, needs: dict[str, str], tried: str, in_map: str, monkeypatch
) -> None:
    """Small letters have position priors: they are tried as they come, the others behind them, what failed until nothing grows."""
    sites = Sites(needs)
    monkeypatch.setattr(multi_session, "extend", sites.extend)
    monkeypatch.setattr(multi_session, "_begun", lambda session, _: (session.survey.map, None))
    joining = MapMerger(None, SurveySettings(), SurveyLimits())
    for letter in sessions:
        survey: Any = SimpleNamespace(name=letter, map=made_up_map(letter))
        joining.add(Session(survey, np.eye(4) if letter.islower() else None))
    joined: Any = joining.finish()
    assert joined.map.letters == in_map
    assert sites.tried == tried
    assert [sessions[o.number] for o in joined.outcomes] == list(sessions)
    assert {sessions[o.number] for o in joined.outcomes if o.verdict is MembershipVerdict.JOINED} == set(in_map)
    stamps = [t.stamps_ns[0] // (10 * SECOND_NS) for t in joined.trajectories]
    assert "".join(map(chr, stamps)) == "".join(letter for letter in sessions if letter in in_map)
