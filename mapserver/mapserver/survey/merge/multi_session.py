"""Several surveys, and the map of a site that has one, become one map. Surveys that cannot be joined are left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.finish.map_transform import transform_map
from mapserver.survey.merge.join_test import JoinEvidence, JoinVerdict, NotJoined
from mapserver.survey.merge.pipeline import Counts, Extension, extend
from mapserver.survey.pipeline import Survey
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_map import SurveyMap

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Session:
    """One recording's survey. map_from_survey: where position priors put it, None without any."""

    survey: Survey
    map_from_survey: Array | None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of session `number`: in the map or left out, why, by what evidence; counts where it was joined to something."""

    number: int
    verdict: JoinVerdict
    reason: str
    counts: Counts | None = None
    evidence: JoinEvidence | None = None

    @property
    def joined(self) -> bool:
        """Whether it is in the map."""
        return self.verdict is JoinVerdict.JOINED


@dataclass(frozen=True, slots=True)
class Joined:
    """The map of all sessions that could be joined, what became of each in their order, and the trajectories of the joined ones.

    estimated: for each trajectory, which of its frames were measured.
    """

    map: SurveyMap
    outcomes: tuple[Outcome, ...]
    trajectories: tuple[Trajectory, ...]
    estimated: tuple[Mask, ...]


def join_sessions(base: SurveyMap | None, sessions: Sequence[Session], settings: SurveySettings) -> Joined:
    """One map of `base` (the published one, None on a new site) and all sessions that find their place in it.

    On a new site the first session with position priors begins, the first of all where none has any. What cannot be
    joined at once is tried again after the others.
    """
    anchored, current = base is not None, base
    outcomes: dict[int, Outcome] = {}
    found: dict[int, tuple[Trajectory, Mask]] = {}
    waiting = sorted(range(len(sessions)), key=lambda n: sessions[n].map_from_survey is None)
    if current is None:
        first = waiting.pop(0)
        current = _begun(sessions[first])
        outcomes[first] = Outcome(first, JoinVerdict.JOINED, "begins the map")
        found[first] = (current.trajectory, current.trajectory_estimated)
    progress = True
    while waiting and progress:
        progress = False
        for number in list(waiting):
            session = sessions[number]
            result = extend(
                current, session.survey, settings, anchored=anchored, map_from_survey=session.map_from_survey
            )
            if isinstance(result, NotJoined):
                outcomes[number] = Outcome(number, result.verdict, result.reason, evidence=result.evidence)
                continue
            outcomes[number] = Outcome(number, JoinVerdict.JOINED, _words(result), result.counts, result.evidence)
            current, progress = result.map, True
            found[number] = (current.trajectory, current.trajectory_estimated)
            waiting.remove(number)
    order = sorted(found)
    return Joined(
        with_trajectories(current, [found[n][0] for n in order], [found[n][1] for n in order]) if order else current,
        tuple(outcomes[n] for n in sorted(outcomes)),
        tuple(found[n][0] for n in order),
        tuple(found[n][1] for n in order),
    )


def _words(result: Extension) -> str:
    found = result.evidence
    return f"found in the map: {found.fixes} fixes at {found.places} places, {found.cells_seen} of {found.cells_expected} parts of it seen"


def _begun(session: Session) -> SurveyMap:
    survey_map = session.survey.map
    return survey_map if session.map_from_survey is None else transform_map(survey_map, session.map_from_survey)


def with_trajectories(
    survey_map: SurveyMap, trajectories: Sequence[Trajectory], estimated: Sequence[Mask]
) -> SurveyMap:
    """The map with the frames of all sessions, one after the other."""
    return replace(
        survey_map, trajectory=chained(trajectories, trajectories), trajectory_estimated=np.concatenate(estimated)
    )


def chained(trajectories: Sequence[Trajectory], clocks: Sequence[Trajectory]) -> Trajectory:
    """One trajectory of several: stamps stay where they follow each other, else a later one's are moved behind those before.

    clocks: by how much is decided on these, so that an estimate and its truth are moved alike.
    """
    stamps, places, end_ns = [], [], -(2**62)
    for trajectory, clock in zip(trajectories, clocks, strict=True):
        behind = end_ns + 1_000_000_000 - int(clock.stamps_ns[0])
        shift_ns = max(behind, 0) if end_ns > -(2**62) else 0
        stamps.append(trajectory.stamps_ns + shift_ns)
        places.append(trajectory.frame_from_body)
        end_ns = int(clock.stamps_ns[-1]) + shift_ns
    return Trajectory(np.concatenate(stamps), np.concatenate(places))
