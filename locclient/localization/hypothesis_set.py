"""Competing pose hypotheses: votes by fixes, ranking, disambiguation, confirmation. Pure."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.relocalization.map_view import LookAlikes
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.time_sliced import TimeSliced
from locclient.localization.alias_disambiguation import ViewpointGate, log_odds, mark_shared
from locclient.localization.place import boxminus
from locclient.localization.pose_hypothesis import PoseHypothesis
from locclient.localization.settings import TrackSettings

_PAIRS_AT_ONCE = 4  # comparisons in a time slice of a query
_MAX_WRONG_SHARE = 0.05  # of unmapped places that weak fixes of a standing robot may confirm by mistake
_STOREY_M = 2.5  # at least

# The fixes of one query, each with its pose propagated to the present.
Observations = Sequence[tuple[Fix, PoseHypothesis]]


class HypothesisSet:
    """Candidates while no pose is confirmed, else the places of refused fixes; or those that contradict a prior.

    hypotheses: in the order of their first fixes. abandoned: the confirmed and published pose that was given up for them after fixes
    contradicted it. lookalikes: similarity of unmapped places to the map, None if not measured.

    Source: multiple hypothesis tracking (Reid 1979), of a single target and without branching.
    """

    def __init__(self, settings: TrackSettings) -> None:
        self._settings = settings
        self.hypotheses: list[PoseHypothesis] = []
        self.abandoned: PoseHypothesis | None = None
        self.lookalikes: LookAlikes | None = None
        self._disambiguated: PoseHypothesis | None = None
        self._viewpoint_gate = ViewpointGate()

    def tracked(self) -> list[PoseHypothesis]:
        return [*self.hypotheses, *([self.abandoned] if self.abandoned else [])]

    def redefine_odom(self, new_odom_from_old_odom: Array) -> None:
        self._viewpoint_gate.redefine_odom(new_odom_from_old_odom)

    def reset(self) -> None:
        """Remove all hypotheses."""
        self.hypotheses, self.abandoned, self._disambiguated = [], None, None

    # --- one query ----------------------------------------------------------------------------------------------------

    def observe(self, observations: Observations, odom_from_body: Array | None) -> None:
        """Add the fixes of one query: each votes for a hypothesis or creates one; drop those without recent votes.

        odom_from_body: at present; None keeps no history of landmarks.
        """
        is_new_viewpoint = odom_from_body is not None and self._viewpoint_gate.is_new(odom_from_body)
        for hypothesis in self.hypotheses:
            hypothesis.misses += 1
            hypothesis.decay(self._settings.evidence_kept_share)
            if is_new_viewpoint:
                hypothesis.history.begin_look()
        for fix, fresh in observations:
            self._vote(fix, fresh, odom_from_body if is_new_viewpoint else None)
        self.hypotheses = [h for h in self.hypotheses if h.misses < self._settings.max_misses]

    def _vote(self, fix: Fix, fresh: PoseHypothesis, odom_from_body: Array | None) -> None:
        """Let a fix vote for the hypothesis at its pose and update it, or create one. fresh: the fix's pose at present."""
        for hypothesis in self.hypotheses:
            if hypothesis.is_same_pose(fresh, self._settings):
                if hypothesis.misses:  # at most one vote per query
                    hypothesis.support, hypothesis.misses = hypothesis.support + fresh.support, 0
                    self._count(hypothesis, fix, fresh, odom_from_body)
                hypothesis.take_pose(fresh)
                return
        fresh.decay(0.0)
        self._count(fresh, fix, fresh, odom_from_body)
        self.hypotheses.append(fresh)

    def _count(self, hypothesis: PoseHypothesis, fix: Fix, fresh: PoseHypothesis, odom_from_body: Array | None) -> None:
        hypothesis.add_fix(fix.inliers, fix.landmark_recall)
        if self._settings.is_whole_site_mapped and fix.covisible is not None and odom_from_body is not None:
            hypothesis.history.add(odom_from_body @ se3_inverse(fresh.now.map_from_body), fix.covisible)

    def update(self, observations: Observations, odom_from_body: Array) -> TimeSliced[None]:
        """Run `observe` and the disambiguation, in time slices."""
        self.observe(observations, odom_from_body)
        self._disambiguated = yield from self._tell_apart()

    # --- ranking ------------------------------------------------------------------------------------------------------

    def ranking(self) -> tuple[list[PoseHypothesis], list[PoseHypothesis]]:
        """Return the hypotheses, the most likely first, and the competitors of the first."""
        order, best = self._ranked(), self._disambiguated
        if not any(h is best for h in order):  # it may have been pruned during the query
            return order, self._competitors(order[0]) if order else []
        return sorted(order, key=lambda h: h is not best), []

    def _ranked(self) -> list[PoseHypothesis]:
        """Return the hypotheses, the one with most inliers first."""
        return sorted(self.hypotheses, key=lambda h: -h.inlier_sum)

    def _competitors(self, best: PoseHypothesis) -> list[PoseHypothesis]:
        """Return hypotheses with nearly the support of `best`, per query since their creation or in this query alone: by inliers, or by
        landmark recall, since a sparsely mapped place is as likely as its alias. A robot that turns into its aisle sees more of the next
        one at first: those observations must not outweigh that both look alike now.
        """
        settings = self._settings

        def is_near(inliers: float, recall: float, best_inliers: float, best_recall: float) -> bool:
            if inliers >= settings.competitor_share * best_inliers:
                return True
            has_recall = recall >= settings.competitor_recall_share * best_recall
            return has_recall and inliers >= settings.competitor_least_share * best_inliers

        def competes(other: PoseHypothesis) -> bool:
            if is_near(other.mean_inliers, other.mean_recall, best.mean_inliers, best.mean_recall):
                return True
            is_seen = other.query_inliers > 0
            return is_seen and is_near(other.query_inliers, other.query_recall, best.query_inliers, best.query_recall)

        return [h for h in self.hypotheses if h is not best and competes(h)]

    def _tell_apart(self) -> TimeSliced[PoseHypothesis | None]:
        """Return the hypothesis whose log odds against every competitor reach the threshold; None if absent. In time slices.

        It need not rank first: a sign has few landmarks beside those that aliases share. An operator's pose counts like a sign. Used only
        if the whole site is mapped: among the aliases of an unmapped place, one is always the most similar. The test is repeated with
        every query, as in a sequential test (Wald 1945); it never rejects.
        """
        order, threshold = self._ranked(), self._settings.telling_evidence
        if not self._settings.is_whole_site_mapped or not order or not self._competitors(order[0]):
            return None
        shared = [np.zeros(len(h.history.ids), bool) for h in order]
        for number, (i, j) in enumerate(combinations(range(len(order)), 2)):
            if number and number % _PAIRS_AT_ONCE == 0:
                yield
            mark_shared(order[i].history, order[j].history, shared[i], shared[j])
        known = {id(h): (h.history, flags) for h, flags in zip(order, shared, strict=True)}

        def lead(one: PoseHypothesis, other: PoseHypothesis) -> float:
            (history, flags), (other_history, other_flags) = known[id(one)], known[id(other)]
            return log_odds(history, other_history, flags, other_flags) + (one.told_log_odds - other.told_log_odds)

        yield
        best = max(order[1:], key=lambda other: lead(other, order[0]))
        if lead(best, order[0]) < threshold:
            best = order[0]
        for number, other in enumerate(self._competitors(best)):
            if number and number % _PAIRS_AT_ONCE == 0:
                yield
            if lead(best, other) < threshold:
                return None
        return best

    # --- confirmation -------------------------------------------------------------------------------------------------

    def may_be_lookalike(self, hypothesis: PoseHypothesis) -> bool:
        """Return True if an unmapped place could look as similar, by its recall and by its inliers."""
        known = self.lookalikes
        return known is not None and self.has_low_recall(hypothesis) and hypothesis.mean_inliers <= known.inliers

    def has_low_recall(self, hypothesis: PoseHypothesis) -> bool:
        """Return True if its recall in all queries so far, which a confirmed pose needs, excludes no unmapped place."""
        return self.lookalikes is not None and 0.0 < self.lookalikes.recall >= hypothesis.recall

    def is_supported(self, hypothesis: PoseHypothesis) -> bool:
        """Return True if enough fixes agreed over enough distance."""
        settings = self._settings
        has_enough = hypothesis.support >= settings.confirming_fixes
        return has_enough and hypothesis.travelled_m >= settings.confirming_distance_m

    def is_confirmed(self, hypothesis: PoseHypothesis, fixes: Sequence[Fix], *, is_one_map: bool = True) -> bool:
        """Return True after enough fixes over enough distance, or for the only hypothesis after an unambiguous fix: a strong one, or one
        of enough agreeing fixes if the map's look-alikes were measured well enough, so that no distance is needed to exclude them.

        is_one_map: one alone was searched; of several, one fix says too little: it may be missing in the right one."""
        settings = self._settings
        if is_one_map and len(self.hypotheses) == len(fixes) == 1:
            fix = fixes[0]
            # It agrees too well for any other place of this map.
            is_unambiguous = fix.inlier_share >= settings.strong_share and fix.alias_ratio < settings.strong_alias_share
            has_enough = hypothesis.support >= settings.confirming_fixes
            is_measured = self.lookalikes is not None and self.lookalikes.max_wrong_share <= _MAX_WRONG_SHARE
            if is_unambiguous and (fix.inliers >= settings.strong_inliers or (has_enough and is_measured)):
                return True
        return self.is_supported(hypothesis)

    def moved_m(self, hypothesis: PoseHypothesis) -> float | None:
        """Return the distance of a hypothesis from the abandoned pose, at least a storey in another map; None if within their covariances
        (Mahalanobis test)."""
        if self.abandoned is None:
            return None
        then, now = self.abandoned.now, hypothesis.now
        error = boxminus(now.map_from_body, then.map_from_body)
        if not then.shares_map(now):
            return max(_STOREY_M, float(np.linalg.norm(error[3:])))
        covariance = now.cov_rot_trans + then.cov_rot_trans
        is_beyond = error @ np.linalg.solve(covariance, error) > self._settings.innovation_limit
        return float(np.linalg.norm(error[3:])) if is_beyond else None
