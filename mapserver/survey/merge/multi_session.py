"""Merge of several surveys, and of a site's existing map, into one map. Surveys that cannot be joined are left out.

One survey is joined in these steps: localization, joint adjustment, comparison, merge.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.geometry import Array, Mask, se3_inverse
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.finish.frame_adjustment import frame_trajectory
from mapserver.survey.loops.connected_components import find_groups
from mapserver.survey.merge import membership
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.changes import SurveyLimits, what_changes
from mapserver.survey.merge.confirmation import firm_landmarks
from mapserver.survey.merge.guided_matching import Sightings, keyframe_features, match_keyframe, session_relocalization
from mapserver.survey.merge.joint_adjustment import JointSolution, Measured, adjust_jointly, begun, grown
from mapserver.survey.merge.landmark_persistence import count_landmarks, faded
from mapserver.survey.merge.membership import Membership, MembershipEvidence, MembershipVerdict, SessionKeyframes
from mapserver.survey.merge.merge import merged
from mapserver.survey.pose_graph.odometry_factors import chain_edges
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import Survey
from mapserver.survey.state import RigImages
from mapserver.survey.survey_map import SurveyMap


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


@dataclass(frozen=True, slots=True)
class Session:
    """One recording's survey. map_from_survey: pose by position priors, None without any."""

    survey: Survey
    map_from_survey: Array | None


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of session `number`: in the map or left out, reason, evidence; counts if it was joined to something."""

    number: int
    verdict: MembershipVerdict
    reason: str
    counts: Counts | None = None
    evidence: MembershipEvidence | None = None

    @property
    def joined(self) -> bool:
        """True if it is in the map."""
        return self.verdict is MembershipVerdict.JOINED


@dataclass(frozen=True, slots=True)
class MergedMap:
    """The map of all joined sessions, the result of each in order, and the trajectories of the joined ones.

    estimated: for each trajectory, a mask of its measured frames.
    """

    map: SurveyMap
    outcomes: tuple[Outcome, ...]
    trajectories: tuple[Trajectory, ...]
    estimated: tuple[Mask, ...]


class MapMerger:
    """Builds one map of `base` (the published one, None on a new site) and all sessions that can be located in it.

    On a new site the first session with position priors starts the map, or the very first if none has any. Sessions with priors are
    joined in order as soon as they are added, independent of later ones; those without, and those not joined at
    once, are tried after all others. The map depends on the order of the sessions, not on the time of adding them.
    """

    def __init__(self, base: SurveyMap | None, settings: SurveySettings, limits: SurveyLimits) -> None:
        self._settings, self._current, self._limits = settings, base, limits
        self._measured: Measured | None = None  # constraints of an unpublished map
        self._sessions: list[Session] = []
        self._waiting: list[int] = []
        self._outcomes: dict[int, Outcome] = {}
        self._found: dict[int, tuple[Trajectory, Mask, int]] = {}  # with the first keyframe in an unpublished map
        self._has_grown = False

    def add(self, session: Session) -> None:
        """Add the next session."""
        self._sessions.append(session)
        self._waiting.append(len(self._sessions) - 1)
        if session.map_from_survey is not None:
            self._try(self._waiting[-1])

    def finish(self) -> MergedMap:
        """Return the map, and the result of every session."""
        self._waiting.sort(key=lambda n: self._sessions[n].map_from_survey is None)
        for number in [n for n in self._waiting if self._sessions[n].map_from_survey is None]:
            self._try(number)
        while self._waiting and self._has_grown:
            self._has_grown = False
            for number in list(self._waiting):
                self._try(number)
        assert self._current is not None, "no session to begin a map with"
        order = sorted(self._found)
        trajectories, estimated = tuple(map(self._trajectory, order)), tuple(self._found[n][1] for n in order)
        joined_map = self._current
        if order:
            frames, are_estimated = chained(trajectories, trajectories), np.concatenate(estimated)
            joined_map = replace(joined_map, trajectory=frames, trajectory_estimated=are_estimated)
        outcomes = tuple(self._outcomes[n] for n in sorted(self._outcomes))
        return MergedMap(joined_map, outcomes, trajectories, estimated)

    def _try(self, number: int) -> None:
        session, known = self._sessions[number], self._measured
        first = 0 if known is None else len(known.problem.map_from_body)
        if self._current is None:
            self._current, self._measured = _begun(session, self._settings)
            outcome = Outcome(number, MembershipVerdict.JOINED, "begins the map")
        else:
            result = extend(self._current, session, self._settings, known, self._limits)
            if isinstance(result, Membership):
                self._outcomes[number] = Outcome(number, result.verdict, result.reason, evidence=result.evidence)
                return
            self._current, self._measured, self._has_grown = result.map, result.measured, True
            seen = result.evidence
            words = f"found in the map: {seen.fixes} fixes at {seen.places} places"
            words += f", {seen.cells_seen} of {seen.cells_expected} parts of it seen"
            outcome = Outcome(number, MembershipVerdict.JOINED, words, result.counts, seen)
        self._outcomes[number] = outcome
        self._found[number] = self._current.trajectory, self._current.trajectory_estimated, first
        self._waiting.remove(number)

    def _trajectory(self, number: int) -> Trajectory:
        """Return that of a joined session: its frames follow its keyframes, which later sessions may have moved in an unpublished map."""
        (found, _, first), survey = self._found[number], self._sessions[number].survey
        if self._measured is None or number == next(reversed(self._found)):
            return found
        problem, count = self._measured.problem, len(survey.odometry.keyframes)
        map_from_cam = problem.map_from_body[first : first + count] @ problem.rig.body_from_cam[0]
        return _carried(found, survey, map_from_cam @ se3_inverse(survey.state.rig.body_from_cam[0]))


def _begun(session: Session, settings: SurveySettings) -> tuple[SurveyMap, Measured]:
    survey_map, state = session.survey.map, session.survey.state
    if session.map_from_survey is not None:
        survey_map = survey_map.transformed(session.map_from_survey)
        state = state.transformed(session.map_from_survey)
    return survey_map, begun(state, survey_map, session.survey.landmarks_in_map, settings)


def chained(trajectories: Sequence[Trajectory], clocks: Sequence[Trajectory]) -> Trajectory:
    """Concatenate trajectories: stamps in order are kept, else later ones are shifted behind the earlier ones.

    clocks: define the shifts, so that an estimate and its truth are shifted alike.
    """
    stamps, places, end_ns = [], [], -(2**62)
    for trajectory, clock in zip(trajectories, clocks, strict=True):
        behind = end_ns + 1_000_000_000 - int(clock.stamps_ns[0])
        shift_ns = max(behind, 0) if end_ns > -(2**62) else 0
        stamps.append(trajectory.stamps_ns + shift_ns)
        places.append(trajectory.frame_from_body)
        end_ns = int(clock.stamps_ns[-1]) + shift_ns
    return Trajectory(np.concatenate(stamps), np.concatenate(places))


def extend(
    base_map: SurveyMap, session: Session, settings: SurveySettings, known: Measured | None, limits: SurveyLimits
) -> Extension | Membership:
    """Return the map joined with a survey that passes the test of `membership`: at the pose by fixes, and after joint adjustment.

    known: constraints of base_map, which is adjusted as a whole; None for a published one, whose landmarks without
    significant motion are bit-identical. limits: what operators do not let surveys change.
    """
    survey = session.survey
    state, guess = survey.state, survey.odometry
    if not (guess.scale_known and base_map.scale_known):
        return Membership(
            "a survey by one camera without IMU has an unknown scale: it can begin a map, not join one; add an IMU or a camera"
        )
    base = BaseMap(base_map, state.rig.camera, state.rig.body_from_cam[0])
    relocalizer = Relocalizer(base.view(survey.vocabulary), base.camera, session_relocalization(settings))
    firm = firm_landmarks(len(base.points_map), base.map.obs_landmark)
    test = membership.MembershipTest(relocalizer, firm, _keyframes_of(session), settings.sessions)
    located = test.locate()
    if isinstance(located, Membership):
        return located
    joint = _adjusted(base, relocalizer, known, survey, located.map_from_body, settings)
    located = replace(located, seen=test.confirmation(joint.map_from_body))
    refused = test.judged(located)
    if refused is not None:
        return refused
    posed = RigImages.of(guess.keyframes, joint.map_from_body, state.rig)
    found = count_landmarks(base, posed.images, posed.map_from_cam, joint.sightings)
    gone = faded(base, found, settings) if known is None else np.zeros(len(base.points_map), bool)
    gone &= ~limits.freezes(base.points_map)
    change, moved_keyframes, moved_landmarks = what_changes(base, survey, posed, joint, gone, settings, limits)
    frozen, least = limits.freezes(change.map_from_cam[:, :3, 3]), settings.sessions.new_place_landmarks
    result, own = merged(base, change, found, posed.images, least, frozen), survey.map
    trajectory = _carried(own.trajectory, survey, joint.map_from_body)
    result = replace(result, trajectory=trajectory, trajectory_estimated=own.trajectory_estimated)
    fresh = int((change.added_rows < 0).sum())
    counts = Counts(
        fixes=test.tried,
        believed_fixes=located.believed,
        keyframes_in_map=int(joint.sightings.located.sum()),
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
    return Extension(result, measured, counts, located.evidence)


def _keyframes_of(session: Session) -> SessionKeyframes:
    """Return a survey as the input of the test of membership."""
    state, guess = session.survey.state, session.survey.odometry
    posed = RigImages.of(guess.keyframes, state.map_from_body, state.rig)
    return SessionKeyframes(
        images=[[keyframe_features(posed.images[n]) for n in row] for row in posed.numbers.tolist()],
        survey_from_body=state.map_from_body,  # the survey's own frame, called `map` in a single survey
        chain=[*chain_edges(guess, state), *session.survey.loops.edges],
        camera=state.rig.camera,
        body_from_cams=state.rig.body_from_cam,
        map_from_survey=session.map_from_survey,
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
        joint = adjust_jointly(base, known, state, map_from_body, Sightings.of(sightings), settings, finely=finely)
        map_from_body = joint.map_from_body
    return joint


def _carried(trajectory: Trajectory, survey: Survey, map_from_body: Array) -> Trajectory:
    """Return the survey's frames: located between its keyframes, they follow those, which are now at map_from_body (K, 4, 4)."""
    stamps_ns, frames = trajectory.stamps_ns, survey.odometry.keyframe_frames
    return Trajectory(stamps_ns, frame_trajectory(stamps_ns, trajectory.frame_from_body, frames, map_from_body))
