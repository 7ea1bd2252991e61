"""Merge of several surveys, and of a site's existing map, into one map. Surveys that cannot be joined are left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.finish.frame_adjustment import frame_trajectory
from mapserver.survey.finish.map_transform import transform_map, transform_state
from mapserver.survey.merge.area_corrections import SurveyLimits
from mapserver.survey.merge.joint_adjustment import Measured, begun
from mapserver.survey.merge.membership import Membership, MembershipEvidence, MembershipVerdict
from mapserver.survey.merge.pipeline import Counts, Extension, extend
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import Survey
from mapserver.survey.survey_map import SurveyMap

Mask = NDArray[np.bool_]
_NO_LIMITS = SurveyLimits()


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

    def __init__(self, base: SurveyMap | None, settings: SurveySettings, limits: SurveyLimits = _NO_LIMITS) -> None:
        self._settings, self._current, self._limits = settings, base, limits
        self._measured: Measured | None = None  # constraints of an unpublished map
        self._sessions: list[Session] = []
        self._waiting: list[int] = []
        self._outcomes: dict[int, Outcome] = {}
        self._found: dict[int, tuple[Trajectory, Mask]] = {}
        self._first_keyframes: dict[int, int] = {}
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
        if self._current is None:
            raise ValueError("no session to begin a map with")
        order = sorted(self._found)
        trajectories, estimated = tuple(map(self._trajectory, order)), tuple(self._found[n][1] for n in order)
        joined_map = with_trajectories(self._current, trajectories, estimated) if order else self._current
        outcomes = tuple(self._outcomes[n] for n in sorted(self._outcomes))
        return MergedMap(joined_map, outcomes, trajectories, estimated)

    def _try(self, number: int) -> None:
        session = self._sessions[number]
        if self._current is None:
            self._current, self._measured = _begun(session, self._settings)
            outcome = Outcome(number, MembershipVerdict.JOINED, "begins the map")
        else:
            known, place = self._measured, session.map_from_survey
            result = extend(
                self._current, session.survey, self._settings, known=known, map_from_survey=place, limits=self._limits
            )
            if isinstance(result, Membership):
                self._outcomes[number] = Outcome(number, result.verdict, result.reason, evidence=result.evidence)
                return
            if known is not None:
                self._first_keyframes[number] = len(known.problem.map_from_body)
            self._current, self._measured, self._has_grown = result.map, result.measured, True
            outcome = Outcome(number, MembershipVerdict.JOINED, _words(result), result.counts, result.evidence)
        self._outcomes[number] = outcome
        self._found[number] = (self._current.trajectory, self._current.trajectory_estimated)
        self._waiting.remove(number)

    def _trajectory(self, number: int) -> Trajectory:
        """Return that of a joined session: its frames follow its keyframes, which later sessions may have moved in an unpublished map."""
        found, survey = self._found[number][0], self._sessions[number].survey
        if self._measured is None or number == next(reversed(self._found)):
            return found
        first = self._first_keyframes.get(number, 0)
        problem, frames = self._measured.problem, survey.odometry.keyframe_frames
        map_from_cam = problem.map_from_body[first : first + len(frames)] @ problem.rig.body_from_cam[0]
        map_from_body = map_from_cam @ se3_inverse(survey.state.rig.body_from_cam[0])
        return replace(
            found, frame_from_body=frame_trajectory(found.stamps_ns, found.frame_from_body, frames, map_from_body)
        )


def _words(result: Extension) -> str:
    found = result.evidence
    return f"found in the map: {found.fixes} fixes at {found.places} places, {found.cells_seen} of {found.cells_expected} parts of it seen"


def _begun(session: Session, settings: SurveySettings) -> tuple[SurveyMap, Measured]:
    survey_map, state = session.survey.map, session.survey.state
    if session.map_from_survey is not None:
        survey_map = transform_map(survey_map, session.map_from_survey)
        state = transform_state(state, session.map_from_survey)
    return survey_map, begun(state, survey_map, session.survey.landmarks_in_map, settings)


def with_trajectories(
    survey_map: SurveyMap, trajectories: Sequence[Trajectory], estimated: Sequence[Mask]
) -> SurveyMap:
    """Return the map with the frames of all sessions, concatenated."""
    return replace(
        survey_map, trajectory=chained(trajectories, trajectories), trajectory_estimated=np.concatenate(estimated)
    )


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
