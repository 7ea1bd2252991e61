"""Stages that make the next map of a survey and a map: found, adjusted together, compared, merged."""

from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.bundle.odometry_factors import chain_edges
from mapserver.survey.finish.trajectory import frame_trajectory
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.changes import what_changes
from mapserver.survey.merge.confirmation import firm_landmarks
from mapserver.survey.merge.guided_matching import Sighting, keyframe_features, match_keyframe, session_relocalizer
from mapserver.survey.merge.joint_adjustment import JointSolution, adjust_jointly
from mapserver.survey.merge.landmark_persistence import count_landmarks, faded
from mapserver.survey.merge.membership import (
    Membership,
    MembershipEvidence,
    MembershipTest,
    SessionKeyframes,
    contradicts,
)
from mapserver.survey.merge.merge import SessionFrames, merged
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import Survey
from mapserver.survey.survey_map import SurveyMap


@dataclass(frozen=True, slots=True)
class Counts:
    """Figures of a join: fixes tried and believed, keyframes found in the map, and the map's landmarks."""

    fixes: int
    believed_fixes: int
    keyframes_in_map: int
    keyframes_added: int
    keyframes_moved: int
    landmarks_expected: int
    landmarks_seen: int
    landmarks_kept: int
    landmarks_moved: int
    landmarks_faded: int
    landmarks_added: int
    seen_rate: float


@dataclass(frozen=True, slots=True)
class Extension:
    """The next map (its trajectory is the new survey's), what changed, and the evidence for joining it."""

    map: SurveyMap
    counts: Counts
    evidence: MembershipEvidence


def extend(
    base_map: SurveyMap,
    survey: Survey,
    settings: SurveySettings,
    *,
    anchored: bool,
    map_from_survey: Array | None = None,
) -> Extension | Membership:
    """The map with a survey joined to it, if it passes the test of `membership`: at the place that fixes say, and once more adjusted.

    anchored: base_map is published: what did not move significantly stays to the bit; else all of it takes its best place.
    map_from_survey: where position priors put the survey, if they do.
    """
    state, guess = survey.state, survey.odometry
    if not (guess.scale_known and base_map.scale_known):
        return Membership(
            "a survey by one camera without IMU has no metres of its own: it can begin a map, not join one"
        )
    base = BaseMap(base_map, state.camera, state.body_from_cam)
    relocalizer = session_relocalizer(base, survey.vocabulary, settings)
    test = _join_test(base, survey, relocalizer, map_from_survey, settings)
    located = test.locate()
    if isinstance(located, Membership):
        return located
    refused = test.judged(located, located.seen)
    if refused is not None and contradicts(located.seen):
        return refused

    def sightings(places_map_from_body: Array, radius_px: float) -> list[Sighting | None]:
        return [
            match_keyframe(base, relocalizer, keyframe, place @ state.body_from_cam, radius_px, settings)
            for keyframe, place in zip(guess.keyframes, places_map_from_body, strict=True)
        ]

    found = sightings(located.map_from_body, settings.sessions.search_px)
    joint = adjust_jointly(base, state, located.map_from_body, found, settings, anchored=anchored)
    found = sightings(joint.map_from_body, settings.sessions.guided_px)
    joint = adjust_jointly(base, state, joint.map_from_body, found, settings, anchored=anchored)
    seen = test.confirmation(joint.map_from_body)
    refused = test.judged(located, seen)
    if refused is not None:
        return refused
    result, counts = _compare(base, survey, joint, settings, anchored, (test.tried, located.believed))
    return Extension(result, counts, test.evidence(located, seen))


def _join_test(
    base: BaseMap, survey: Survey, relocalizer: Relocalizer, map_from_survey: Array | None, settings: SurveySettings
) -> MembershipTest:
    state, guess = survey.state, survey.odometry
    visit = SessionKeyframes(
        keyframes=[keyframe_features(keyframe) for keyframe in guess.keyframes],
        survey_from_body=state.map_from_body,  # the survey's own frame, named `map` before there was another
        chain=[*chain_edges(guess, state), *survey.loops.edges],
        camera=state.camera,
        body_from_cam=state.body_from_cam,
        map_from_survey=map_from_survey,
    )
    firm = firm_landmarks(len(base.points_map), base.map.obs_landmark)
    return MembershipTest(relocalizer, firm, visit, settings.sessions)


def _compare(
    base: BaseMap,
    survey: Survey,
    joint: JointSolution,
    settings: SurveySettings,
    anchored: bool,
    fixes: tuple[int, int],
) -> tuple[SurveyMap, Counts]:
    state, guess = survey.state, survey.odometry
    map_from_cam = joint.map_from_body @ state.body_from_cam
    seen = count_landmarks(base, guess.keyframes, map_from_cam, joint.sightings)
    gone = faded(base, seen, settings) if anchored else np.zeros(len(base.points_map), bool)
    change, moved_keyframes, moved_landmarks = what_changes(base, survey, joint, gone, settings, anchored=anchored)
    # Between keyframes the survey's own frames were placed by what they saw; they follow the keyframes that moved.
    stamps_ns, survey_from_body = survey.map.trajectory.stamps_ns, survey.map.trajectory.frame_from_body
    numbers = [k.frame_index for k in guess.keyframes]
    trajectory = Trajectory(stamps_ns, frame_trajectory(stamps_ns, survey_from_body, numbers, joint.map_from_body))
    frames = SessionFrames(guess.keyframes, trajectory, survey.map.trajectory_estimated)
    result = merged(base, change, seen, frames, settings.sessions.new_place_landmarks)
    fresh = int((change.added_rows < 0).sum())
    counts = Counts(
        fixes=fixes[0],
        believed_fixes=fixes[1],
        keyframes_in_map=sum(s is not None for s in joint.sightings),
        keyframes_added=len(np.unique(change.added.obs_keyframe)),
        keyframes_moved=moved_keyframes,
        landmarks_expected=int((seen.expected > 0).sum()),
        landmarks_seen=int((seen.seen > 0).sum()),
        landmarks_kept=len(result.landmark_ids) - fresh - moved_landmarks,
        landmarks_moved=moved_landmarks,
        landmarks_faded=int(gone.sum()),
        landmarks_added=fresh,
        seen_rate=round(seen.rate, 4),
    )
    return result, counts
