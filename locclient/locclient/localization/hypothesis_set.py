"""Pose hypotheses from the first fix until one is confirmed. Pure."""

from collections.abc import Sequence

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.time_sliced import TimeSliced
from fleetmap.relocalization.map_view import LookAlikes
from fleetmap.relocalization.relocalizer import Fix
from locclient.localization import hypothesis_scoring as scoring
from locclient.localization.alias_disambiguation import ViewpointGate
from locclient.localization.pose_covariance import boxminus
from locclient.localization.pose_hypothesis import PoseHypothesis
from locclient.localization.settings import TrackSettings

# The fixes of one query, and each one's pose, propagated to the present.
Observations = Sequence[tuple[Fix, PoseHypothesis]]
_MAX_WRONG_SHARE = 0.05  # of unmapped places that may be believed by weak fixes of a robot that stands


class HypothesisSet:
    """Competing pose hypotheses, and the pose that was abandoned for them. hypotheses: in the order of their first fixes.

    Source: multiple hypothesis tracking (Reid 1979), of a single target and without branching.
    """

    def __init__(self, settings: TrackSettings) -> None:
        self._settings = settings
        self.hypotheses: list[PoseHypothesis] = []
        self._disambiguated: PoseHypothesis | None = None
        self._abandoned: PoseHypothesis | None = None  # published as the robot's pose until fixes named another
        self._viewpoint_gate = ViewpointGate()
        self.lookalikes: LookAlikes | None = None  # None where nobody measured them

    def tracked(self) -> list[PoseHypothesis]:
        """All that must be propagated by the odometry."""
        return [*self.hypotheses, *([self._abandoned] if self._abandoned else [])]

    def redefine_odom(self, new_odom_from_old_odom: Array) -> None:
        self._viewpoint_gate.redefine_odom(new_odom_from_old_odom)

    def reset(self, abandoned: PoseHypothesis | None = None, hypotheses: Sequence[PoseHypothesis] = ()) -> None:
        """Starts over with these hypotheses, for which the confirmed pose was abandoned; with none after one is confirmed."""
        self._abandoned, self.hypotheses, self._disambiguated = abandoned, list(hypotheses), None

    def observe(self, observations: Observations, hypotheses: list[PoseHypothesis], odom_from_body: Array) -> None:
        """One query: every fix votes for one of `hypotheses`, or founds one."""
        is_new = self._viewpoint_gate.is_new(odom_from_body)
        scoring.begin_query(hypotheses, self._settings, is_new_viewpoint=is_new)
        for fix, fresh in observations:
            scoring.vote(hypotheses, fix, fresh, odom_from_body if is_new else None, self._settings)

    def update(self, observations: Observations, odom_from_body: Array) -> TimeSliced[None]:
        """Votes, pruning and disambiguation by one query; in time slices."""
        self.observe(observations, self.hypotheses, odom_from_body)
        self.hypotheses = scoring.recent(self.hypotheses, self._settings)
        self._disambiguated = yield from scoring.disambiguated(self.hypotheses, self._settings)

    def ranking(self) -> tuple[list[PoseHypothesis], list[PoseHypothesis]]:
        """The hypotheses, the most likely first, and the competitors of that one."""
        order, best = scoring.ranked(self.hypotheses), self._disambiguated
        if not any(h is best for h in order):  # it may have been pruned in a query that goes on
            return order, scoring.competitors(self.hypotheses, self._settings)
        return sorted(order, key=lambda h: h is not best), []

    def may_be_lookalike(self, hypothesis: PoseHypothesis) -> bool:
        """Whether a place that is not in the map could look as much like the hypothesis: by its recall in all queries so far."""
        return self.lookalikes is not None and 0.0 < self.lookalikes.recall >= hypothesis.recall

    def is_confirmed(self, hypothesis: PoseHypothesis, fixes: Sequence[Fix]) -> bool:
        """By enough fixes over enough distance, or as the only hypothesis by an unambiguous fix: a strong one, or one of enough that
        agree where the map's look-alikes were measured well enough, so that no distance needs to exclude them."""
        if len(self.hypotheses) == len(fixes) == 1 and scoring.is_unambiguous(fixes[0], self._settings):
            has_enough = hypothesis.support >= self._settings.confirming_fixes
            is_measured = self.lookalikes is not None and self.lookalikes.max_wrong_share <= _MAX_WRONG_SHARE
            if fixes[0].inliers >= self._settings.strong_inliers or (has_enough and is_measured):
                return True
        return scoring.is_supported(hypothesis, self._settings)

    def moved_m(self, hypothesis: PoseHypothesis) -> float | None:
        """The distance of a hypothesis from the abandoned pose; None where their covariances admit it (Mahalanobis test)."""
        if self._abandoned is None:
            return None
        error = boxminus(hypothesis.now_map_from_body, self._abandoned.now_map_from_body)
        covariance = hypothesis.now_cov + self._abandoned.now_cov
        is_beyond = error @ np.linalg.solve(covariance, error) > self._settings.innovation_limit
        return float(np.linalg.norm(error[3:])) if is_beyond else None
