"""Stages that merge a survey into a map: localization, joint adjustment, comparison, merge."""

from dataclasses import dataclass, replace

import numpy as np

from fleetmap.geometry import Array
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.finish.frame_adjustment import frame_trajectory
from mapserver.survey.loops.connected_components import find_groups
from mapserver.survey.merge.area_corrections import SurveyLimits
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.changes import what_changes
from mapserver.survey.merge.confirmation import firm_landmarks
from mapserver.survey.merge.guided_matching import keyframe_features, match_keyframe, session_relocalizer
from mapserver.survey.merge.joint_adjustment import JointSolution, Measured, adjust_jointly, grown
from mapserver.survey.merge.landmark_persistence import count_landmarks, faded
from mapserver.survey.merge.membership import (
    Membership,
    MembershipEvidence,
    MembershipTest,
    SessionKeyframes,
    SessionPlace,
    contradicts,
)
from mapserver.survey.merge.merge import merged
from mapserver.survey.pose_graph.odometry_factors import chain_edges
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import Survey
from mapserver.survey.state import RigImages
from mapserver.survey.survey_map import SurveyMap

_NO_LIMITS = SurveyLimits()


@dataclass(frozen=True, slots=True)
class Counts:
    """Figures of a join: fixes tried and accepted, keyframes located in the map, refused priors, and the map's landmarks."""

    fixes: int
    believed_fixes: int
    keyframes_in_map: int
    keyframes_added: int
    keyframes_moved: int
    priors_refused: int
    landmarks_expected: int
    landmarks_seen: int
    landmarks_kept: int
    landmarks_moved: int
    landmarks_faded: int
    landmarks_added: int
    seen_rate: float


@dataclass(frozen=True, slots=True)
class Extension:
    """The next map (its trajectory is the new survey's), its constraints, its changes, and the evidence for the join."""

    map: SurveyMap
    measured: Measured | None
    counts: Counts
    evidence: MembershipEvidence


def extend(
    base_map: SurveyMap,
    survey: Survey,
    settings: SurveySettings,
    *,
    known: Measured | None = None,
    map_from_survey: Array | None = None,
    limits: SurveyLimits = _NO_LIMITS,
) -> Extension | Membership:
    """Return the map joined with a survey that passes the test of `membership`: at the pose by fixes, and after joint adjustment.

    known: constraints of base_map, which is adjusted as a whole; None for a published one, whose landmarks without
    significant motion are bit-identical.
    map_from_survey: pose by position priors, if any. limits: what operators do not let surveys change.
    """
    state, guess = survey.state, survey.odometry
    if not (guess.scale_known and base_map.scale_known):
        return Membership(
            "a survey by one camera without IMU has an unknown scale: it can begin a map, not join one; add an IMU or a camera"
        )
    base = BaseMap(base_map, state.rig.camera, state.rig.body_from_cam[0])
    relocalizer = session_relocalizer(base, survey.vocabulary, settings)
    firm = firm_landmarks(len(base.points_map), base.map.obs_landmark)
    test = MembershipTest(relocalizer, firm, _session(survey, map_from_survey), settings.sessions)
    located = _located(test)
    if isinstance(located, Membership):
        return located
    joint = _adjusted(base, relocalizer, known, survey, located.map_from_body, settings)
    seen = test.confirmation(joint.map_from_body)
    refused = test.judged(located, seen)
    if refused is not None:
        return refused
    posed = RigImages.of(guess.keyframes, joint.map_from_body, state.rig)
    found, anchored = count_landmarks(base, posed.images, posed.map_from_cam, joint.sightings), known is None
    gone = faded(base, found, settings) if anchored else np.zeros(len(base.points_map), bool)
    gone &= ~limits.freezes(base.points_map)
    change, moved_keyframes, moved_landmarks = what_changes(
        base, survey, posed, joint, gone, settings, anchored=anchored, limits=limits
    )
    frozen, least = limits.freezes(change.map_from_cam[:, :3, 3]), settings.sessions.new_place_landmarks
    result = _with_frames(merged(base, change, found, posed.images, least, frozen), survey, joint)
    fresh = int((change.added_rows < 0).sum())
    counts = Counts(
        fixes=test.tried,
        believed_fixes=located.believed,
        keyframes_in_map=sum(s is not None for s in joint.sightings),
        keyframes_added=len(np.unique(change.added.obs_keyframe)),
        keyframes_moved=moved_keyframes,
        priors_refused=joint.priors_refused,
        landmarks_expected=int((found.expected > 0).sum()),
        landmarks_seen=int((found.seen > 0).sum()),
        landmarks_kept=len(result.landmark_ids) - fresh - moved_landmarks,
        landmarks_moved=moved_landmarks,
        landmarks_faded=int(gone.sum()),
        landmarks_added=fresh,
        seen_rate=round(found.rate, 4),
    )
    measured = None if known is None else grown(joint, change, base, result)
    return Extension(result, measured, counts, test.evidence(located, seen))


def _located(test: MembershipTest) -> SessionPlace | Membership:
    """Return the pose of a session in the map; why not if it has none, or if its view of the map contradicts it there."""
    located = test.locate()
    if isinstance(located, Membership) or not contradicts(located.seen):
        return located
    return test.judged(located, located.seen) or located


def _session(survey: Survey, map_from_survey: Array | None) -> SessionKeyframes:
    """Return a survey as the input of the test of membership."""
    state, guess = survey.state, survey.odometry
    posed = RigImages.of(guess.keyframes, state.map_from_body, state.rig)
    return SessionKeyframes(
        images=[[keyframe_features(posed.images[n]) for n in row] for row in posed.numbers.tolist()],
        survey_from_body=state.map_from_body,  # the survey's own frame, called `map` in a single survey
        chain=[*chain_edges(guess, state), *survey.loops.edges],
        camera=state.rig.camera,
        body_from_cams=state.rig.body_from_cam,
        map_from_survey=map_from_survey,
        pieces=find_groups(state, lambda *_: np.inf, 0.0).labels(),
    )


def _adjusted(
    base: BaseMap,
    relocalizer: Relocalizer,
    known: Measured | None,
    survey: Survey,
    map_from_body: Array,
    settings: SurveySettings,
) -> JointSolution:
    """Return the joint adjustment with the landmarks of the map that keyframes at map_from_body (K, 4, 4) see, matched twice."""
    state, sessions = survey.state, settings.sessions
    for radius_px, finely in ((sessions.search_px, False), (sessions.guided_px, True)):
        posed = RigImages.of(survey.odometry.keyframes, map_from_body, state.rig)
        sightings = [
            match_keyframe(base, relocalizer, image, place, radius_px, settings)
            for image, place in zip(posed.images, posed.map_from_cam, strict=True)
        ]
        joint = adjust_jointly(base, known, state, map_from_body, sightings, settings, finely=finely)
        map_from_body = joint.map_from_body
    return joint


def _with_frames(survey_map: SurveyMap, survey: Survey, joint: JointSolution) -> SurveyMap:
    """Return the map with the new survey's frames: located between keyframes within the survey, they follow those."""
    own = survey.map.trajectory
    places = frame_trajectory(own.stamps_ns, own.frame_from_body, survey.odometry.keyframe_frames, joint.map_from_body)
    estimated = survey.map.trajectory_estimated
    return replace(survey_map, trajectory=Trajectory(own.stamps_ns, places), trajectory_estimated=estimated)
