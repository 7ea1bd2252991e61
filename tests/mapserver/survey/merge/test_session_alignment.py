"""Where a survey lies in the map: the fixes that agree, unless others agree as well."""

import numpy as np

from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp
from mapserver.survey.merge.session_alignment import Placed, SessionFix, follow_fixes, place_survey
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.settings import SessionSettings

MAP_FROM_SURVEY = se3(so3_exp(np.array([0, 0, 0.7])), np.array([12.0, -3.0, 0.4]))
SETTINGS = SessionSettings()
COVARIANCE = np.diag([0.003**2] * 3 + [0.02**2] * 3)


def drive(count: int = 20) -> Array:
    """survey_from_body (K, 4, 4): a bend of half a metre a step."""
    step, places = se3(so3_exp(np.array([0, 0, 0.05])), np.array([0.5, 0, 0])), [np.eye(4)]
    for _ in range(count - 1):
        places.append(places[-1] @ step)
    return np.array(places)


def fix(k: int, map_from_survey: Array, seed: int = 0) -> SessionFix:
    noise = se3_exp(np.random.default_rng(100 * seed + k).normal(0, [0.003] * 3 + [0.02] * 3))
    return SessionFix(k, map_from_survey @ drive()[k] @ noise, COVARIANCE, 40)


def shifted(metres: float) -> Array:
    """The map from the survey one aisle on."""
    return se3(np.eye(3), np.array([0.0, metres, 0.0])) @ MAP_FROM_SURVEY


def test_agreeing_fixes_place_the_survey_and_strays_do_not_matter() -> None:
    fixes = [fix(k, MAP_FROM_SURVEY) for k in range(0, 20, 2)]
    strays = [fix(3, shifted(9.0)), fix(7, shifted(-4.0)), fix(8, shifted(2.5))]
    placed = place_survey([*strays, *fixes], drive(), None, SETTINGS)
    assert isinstance(placed, Placed)
    assert {f.k for f in placed.fixes} == set(range(0, 20, 2))
    off = se3_inverse(MAP_FROM_SURVEY) @ placed.map_from_survey
    assert np.linalg.norm(off[:3, 3]) < 0.15


def test_two_places_that_explain_the_survey_alike_are_refused() -> None:
    """Identical aisles: what speaks for one place speaks for the other. A prior that knows the aisle decides."""
    fixes = [fix(k, m) for k in range(0, 20, 2) for m in (MAP_FROM_SURVEY, shifted(5.0))]
    refused = place_survey(fixes, drive(), None, SETTINGS)
    assert isinstance(refused, str)
    assert "alike" in refused
    placed = place_survey(fixes, drive(), MAP_FROM_SURVEY, SETTINGS)
    assert isinstance(placed, Placed)
    assert np.linalg.norm((se3_inverse(MAP_FROM_SURVEY) @ placed.map_from_survey)[:3, 3]) < 0.15


def test_a_prior_far_from_all_fixes_leaves_none() -> None:
    fixes = [fix(k, MAP_FROM_SURVEY) for k in range(0, 20, 2)]
    refused = place_survey(fixes, drive(), shifted(40.0), SETTINGS)
    assert isinstance(refused, str)
    assert "0 fixes" in refused


def test_too_few_fixes_place_nothing() -> None:
    for fixes in ([], [fix(1, MAP_FROM_SURVEY), fix(2, MAP_FROM_SURVEY), fix(9, MAP_FROM_SURVEY)]):
        assert isinstance(place_survey(fixes, drive(), None, SETTINGS), str)
    disagreeing = [fix(k, shifted(3.0 * k)) for k in range(8)]
    refused = place_survey(disagreeing, drive(), None, SETTINGS)
    assert isinstance(refused, str)
    assert "at most 1 of 8" in refused


def test_a_survey_that_drifted_is_bent_onto_the_map_and_a_wrong_fix_is_disbelieved() -> None:
    """The survey's own shape is off by a millimetre and half a milliradian each step; fixes see the truth, but for one."""
    rng = np.random.default_rng(5)
    true, chain, drifted = drive(), [], [np.eye(4)]
    for k in range(19):
        step = se3_inverse(true[k]) @ true[k + 1] @ se3_exp(rng.normal(2e-3, 1e-4, 6))
        drifted.append(drifted[-1] @ step)
        chain.append(PoseEdge(k, k + 1, step, np.diag([0.004**2] * 3 + [0.01**2] * 3), is_loop=False))
    fixes = tuple(fix(k, MAP_FROM_SURVEY) if k != 9 else fix(k, shifted(0.5)) for k in range(1, 20, 2))
    start = MAP_FROM_SURVEY @ np.array(drifted)
    placed, believed = follow_fixes(Placed(fixes, MAP_FROM_SURVEY), np.array(drifted), chain)
    wanted = MAP_FROM_SURVEY @ true
    before, after = (np.linalg.norm((p - wanted)[:, :3, 3], axis=1).max() for p in (start, placed))
    assert before > 0.1
    assert after < 0.03
    assert believed == len(fixes) - 1
