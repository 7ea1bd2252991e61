"""Alignment of a survey to the map: many fixes, of which the largest set that agrees is believed if no other comes near it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse
from fleetmap.numerics.time_sliced import finished
from fleetmap.relocalization.relocalizer import Fix, Relocalizer
from mapserver.survey.keyframes.keyframes import Keyframe
from mapserver.survey.merge.guided_matching import keyframe_features
from mapserver.survey.pose_graph.pose_graph import PoseEdge, adjoint, optimize_pose_graph
from mapserver.survey.settings import SessionSettings


@dataclass(frozen=True, slots=True)
class SessionFix:
    """Keyframe k of the new survey found in the map: map_from_body (4, 4), the covariance of its inverse in body axes, inliers."""

    k: int
    map_from_body: Array
    cov_rot_trans: Array
    inliers: int


@dataclass(frozen=True, slots=True)
class Placed:
    """The fixes that agree (one for each keyframe), and map_from_survey (4, 4) of the best of them."""

    fixes: tuple[SessionFix, ...]
    map_from_survey: Array


def find_fixes(
    relocalizer: Relocalizer, keyframes: Sequence[Keyframe], body_from_cam: Array, max_keyframes: int
) -> list[SessionFix]:
    """All fixes of at most `max_keyframes` keyframes, several for one keyframe where the map looks alike in several places."""
    step = max(1, -(-len(keyframes) // max_keyframes))
    return [
        _at_body(k, fix, body_from_cam)
        for k in range(0, len(keyframes), step)
        for fix in finished(relocalizer.anywhere(keyframe_features(keyframes[k])))
    ]


def _at_body(k: int, fix: Fix, body_from_cam: Array) -> SessionFix:
    """The fix of keyframe k, its covariance turned from map axes to the camera's and carried to the body."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = fix.map_from_cam[:3, :3].T
    carry = adjoint(body_from_cam) @ turn
    return SessionFix(
        k, fix.map_from_cam @ se3_inverse(body_from_cam), carry @ fix.cov_rot_trans @ carry.T, fix.inliers
    )


def place_survey(
    fixes: Sequence[SessionFix], survey_from_body: Array, expected: Array | None, settings: SessionSettings
) -> Placed | str:
    """The fixes that agree on where the survey lies, or why they cannot be believed.

    survey_from_body (K, 4, 4). expected: map_from_survey by position priors, None without; fixes far from it are left out.
    """
    if expected is not None:
        fixes = [f for f in fixes if _near_priors(f, expected @ survey_from_body[f.k])]
    if len({fix.k for fix in fixes}) < settings.min_fixes:
        return f"{len(fixes)} fixes in the map, {settings.min_fixes} are needed"
    supports = [_agreeing(fix, fixes, survey_from_body, settings) for fix in fixes]
    best = max(range(len(fixes)), key=lambda n: (len(supports[n]), sum(f.inliers for f in supports[n])))
    chosen = supports[best]
    if len(chosen) < settings.min_fixes:
        return f"at most {len(chosen)} of {len(fixes)} fixes agree on where it lies, {settings.min_fixes} are needed"
    claimed = {id(fix) for fix in chosen}
    rival = max((len(s) for s in supports if not claimed & {id(f) for f in s}), default=0)
    if rival >= settings.rival_share * len(chosen):
        return f"{len(chosen)} fixes say one place and {rival} another: the map looks alike there"
    return Placed(tuple(chosen), fixes[best].map_from_body @ se3_inverse(survey_from_body[fixes[best].k]))


def _near_priors(fix: SessionFix, expected: Array, slack_m: float = 3.0) -> bool:
    return bool(np.linalg.norm(fix.map_from_body[:3, 3] - expected[:3, 3]) < slack_m)


def _agreeing(
    seed: SessionFix, fixes: Sequence[SessionFix], survey_from_body: Array, settings: SessionSettings
) -> list[SessionFix]:
    """Of every keyframe the fix that lies where `seed` would have it, if there is one."""
    map_from_survey = seed.map_from_body @ se3_inverse(survey_from_body[seed.k])
    agreeing: dict[int, SessionFix] = {}
    for fix in fixes:
        off = se3_inverse(map_from_survey @ survey_from_body[fix.k]) @ fix.map_from_body
        way_m = float(np.linalg.norm(survey_from_body[fix.k, :3, 3] - survey_from_body[seed.k, :3, 3]))
        close = np.linalg.norm(off[:3, 3]) < settings.agreement_m + settings.agreement_share * way_m
        turned = rotation_angle_rad(off[:3, :3])
        if close and turned < np.radians(settings.agreement_deg) and fix.k not in agreeing:
            agreeing[fix.k] = fix
    return list(agreeing.values())


def follow_fixes(placed: Placed, survey_from_body: Array, chain: Sequence[PoseEdge]) -> tuple[Array, int]:
    """map_from_body (K, 4, 4) by the pose graph of the survey's own edges and the fixes, and how many fixes were believed."""
    start = np.concatenate([np.eye(4)[None], placed.map_from_survey @ survey_from_body])
    edges = [PoseEdge(e.i + 1, e.j + 1, e.i_from_j, e.cov_rot_trans, is_loop=False) for e in chain]
    edges += [
        PoseEdge(fix.k + 1, 0, se3_inverse(fix.map_from_body), fix.cov_rot_trans, is_loop=True) for fix in placed.fixes
    ]
    solved = optimize_pose_graph(start, edges)
    return solved.map_from_body[1:], int((solved.loop_weights >= 0.5).sum())
