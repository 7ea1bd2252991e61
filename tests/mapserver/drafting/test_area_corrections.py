"""Corrections by areas, at the landmarks and the tiles' evidence."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import inside_any
from fleetmap.sensors.samples import Trajectory
from mapserver.drafting.area_corrections import AreaCorrections
from mapserver.floor_plan.areas import Area, Areas, Correction, CorrectionKind, corrections_of
from mapserver.quality.gate import GateSettings, judge
from mapserver.survey.merge import multi_session
from mapserver.survey.merge.changes import SurveyLimits, is_before
from mapserver.survey.merge.merge import kept
from mapserver.survey.merge.multi_session import MergedMap
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_map import SurveyMap, history_of
from support.storage.map_samples import random_survey

FORGET, NEVER_USE, FREEZE = CorrectionKind
NOW_NS = 1_700_000_000 * 10**9


def area(kind: CorrectionKind, low: tuple[float, float], high: tuple[float, float], since_ns: int = NOW_NS) -> Area:
    ring = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    return Area(f"{kind} {low}", ((ring,),), correction=Correction(kind, "moved", since_ns))


def manifest(**configuration: object) -> Any:
    return SimpleNamespace(configuration=configuration)


@pytest.fixture
def survey() -> SurveyMap:
    return random_survey(np.random.default_rng(4), keyframes=8, landmarks=200)


def test_a_map_without_some_landmarks_is_otherwise_the_same(survey: SurveyMap) -> None:
    keep = np.random.default_rng(1).random(len(survey.landmark_ids)) > 0.3
    keep[survey.obs_landmark[survey.obs_keyframe == 3]] = False  # this keyframe then sees nothing
    left = kept(survey, keep)
    assert len(left.map_from_body) == 7
    np.testing.assert_array_equal(left.landmark_ids, survey.landmark_ids[keep])
    np.testing.assert_array_equal(history_of(left).keyframe_ids, np.delete(history_of(survey).keyframe_ids, 3))
    rows = keep[survey.obs_landmark]
    for one, other in ((left, np.ones(len(left.obs_landmark), bool)), (survey, rows)):
        seen = one.points_map[one.obs_landmark[other]], one.map_from_body[one.obs_keyframe[other]]
        np.testing.assert_array_equal(seen[0], survey.points_map[survey.obs_landmark[rows]])
        np.testing.assert_array_equal(seen[1], survey.map_from_body[survey.obs_keyframe[rows]])
    assert history_of(left).next_landmark_id == history_of(survey).next_landmark_id, "ids are never used again"


def test_what_surveys_may_add_depends_on_when_they_ended() -> None:
    (rings,) = area(FORGET, (0, 0), (4, 4)).polygons
    limits = SurveyLimits(frozen=area(FREEZE, (10, 0), (14, 4)).polygons, since=((rings, NOW_NS),))
    points = np.array([[1.0, 1.0, 7.0], [12.0, 1.0, -3.0], [20.0, 1.0, 0.0], [np.nan, 0.0, 0.0]])
    assert limits.closes(points, NOW_NS + 1).tolist() == [False, True, False, False]
    assert limits.closes(points, NOW_NS - 1).tolist() == [True, True, False, False]
    assert limits.freezes(points).tolist() == [False, True, False, False]
    assert not is_before(77 * 10**9, NOW_NS), "a clock that counts from a start says nothing"


def test_points_are_inside_as_the_even_odd_rule_says_however_many_there_are() -> None:
    points = np.random.default_rng(0).uniform(-1, 5, (300_000, 2))
    ring = area(FREEZE, (0, 0), (4, 4)).rings[0]
    hole = area(FREEZE, (1, 1), (2, 2)).rings[0]
    inside = ((points > 0) & (points < 4)).all(axis=1)
    in_hole = ((points > 1) & (points < 2)).all(axis=1)
    np.testing.assert_array_equal(inside_any(points, [(ring, hole)]), inside & ~in_hole)
    np.testing.assert_array_equal(inside_any(points, [(ring,), (hole,)]), inside)


@pytest.mark.parametrize("drives", ["there", "elsewhere", "there before"])
def test_an_area_is_forgotten_once_a_later_recording_covers_it(survey: SurveyMap, drives: str, monkeypatch) -> None:
    """The recording is joined to a map without it, and once more to the whole map if it does not show what is there now."""
    due = area(FORGET, (-1e3, -1e3), (1e3, 1e3))
    glass = area(NEVER_USE, tuple(survey.points_map[5, :2] - 0.01), tuple(survey.points_map[5, :2] + 0.01))
    bases: list[SurveyMap] = []

    def extend(base: SurveyMap, *_: object, **__: object) -> Any:
        bases.append(base)
        end_ns = NOW_NS + (-1 if drives == "there before" else 1) * 10**9
        path = survey.map_from_body.copy()
        path[:, 0, 3] += 500.0 if drives == "elsewhere" else 0.0
        drive = Trajectory(end_ns + np.arange(-len(path), 0), path)
        grown = replace(base, trajectory=drive, trajectory_estimated=np.ones(len(path), bool))
        evidence = SimpleNamespace(fixes=3, places=3, cells_seen=9, cells_expected=9)
        return SimpleNamespace(map=grown, measured=None, counts=None, evidence=evidence)

    monkeypatch.setattr(multi_session, "extend", extend)
    done: Any = SimpleNamespace(survey=None, map_from_survey=None)
    found, applied = AreaCorrections([due, glass], [due]).joined(survey, [done], SurveySettings())
    assert isinstance(found, MergedMap)
    assert len(bases[0].landmark_ids) == 0
    if drives == "there":
        assert (len(bases), applied.due) == (1, [due])
    else:
        assert [len(base.landmark_ids) for base in bases] == [0, len(survey.landmark_ids) - 1]
        assert (applied.areas, applied.due) == ([glass], [])


def test_a_version_knows_its_corrections() -> None:
    areas = Areas.of([area(FORGET, (0, 0), (1, 1)), area(FREEZE, (5, 5), (6, 6))])
    assert [one.name for one in AreaCorrections.of(areas, manifest()).due] == ["forget (0, 0)"]
    configuration = AreaCorrections(areas.areas).configuration("lab")
    assert corrections_of(manifest(**configuration)).geojson("lab") == areas.geojson("lab")
    assert AreaCorrections.of(areas, manifest(**configuration)).due == []
    again = Areas.of([area(FORGET, (0, 0), (1, 1), NOW_NS + 1)])
    assert AreaCorrections.of(again, manifest(**configuration)).due == list(again.areas)


def test_the_gate_does_not_count_what_corrections_removed() -> None:
    def version(number: int, landmarks: tuple[int, ...], removed: dict[str, int], parent: int | None) -> Any:
        tiles = [SimpleNamespace(x=n, y=0, landmarks=count) for n, count in enumerate(landmarks)]
        report = {"joins": {}, "removed_landmarks": removed}
        whole = SimpleNamespace(tiles=tiles, landmarks=sum(landmarks), tile_bytes=1000, report=report, version=number)
        return SimpleNamespace(**vars(whole), parent=parent, recordings=(), configuration={})

    def reasons(removed: dict[str, int], parent: int) -> tuple[str, ...]:
        draft = version(3, (400, 40), removed, parent)
        return judge(draft, version(2, (400, 400), {}, 1), GateSettings()).reasons

    assert reasons({"1,0": 350}, 2) == ()
    assert len(reasons({}, 2)) == 2
    assert len(reasons({"1,0": 350}, 1)) == 2, "it was built on another version"
