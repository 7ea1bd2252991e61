"""The places that fixes speak for, from the first fix until one of them is believed. Pure."""

from collections.abc import Sequence

import numpy as np

from fleetmap.geometry import Array
from fleetmap.relocalization.relocalizer import Fix, TimeSliced
from locclient.localization.alias_disambiguation import Spot
from locclient.localization.hypothesis_scoring import (
    begin_look,
    disambiguated,
    is_proven,
    is_unambiguous,
    ranked,
    rivals,
    still_held,
    vote,
)
from locclient.localization.pose_hypothesis import PoseHypothesis, difference
from locclient.localization.settings import TrackSettings

Heard = Sequence[tuple[Fix, PoseHypothesis]]  # the fixes of one look, and each one's place, carried to the present


class HypothesisSet:
    """Candidates, what tells them apart, and the place that was given up for them.

    places: the candidates, in the order in which they were thought of.
    """

    def __init__(self, settings: TrackSettings) -> None:
        self._settings = settings
        self.places: list[PoseHypothesis] = []
        self._told_apart: PoseHypothesis | None = None  # the one of them that none of the others can be
        self._given_up: PoseHypothesis | None = None  # what was said to be the place until fixes named another
        self._spot = Spot()

    def anchors(self) -> list[PoseHypothesis]:
        """All that the odometry must carry along."""
        return [*self.places, *([self._given_up] if self._given_up else [])]

    def carry(self, new_odom_from_old_odom: Array) -> None:
        """The odometry began anew."""
        self._spot.carry(new_odom_from_old_odom)

    def reopen(self, given_up: PoseHypothesis, strangers: list[PoseHypothesis]) -> None:
        """What was believed is not any more; these are the candidates now."""
        self._given_up, self.places, self._told_apart = given_up, strangers, None

    def close(self) -> None:
        """One of them is believed."""
        self.places, self._given_up, self._told_apart = [], None, None

    def hear(self, heard: Heard, candidates: list[PoseHypothesis], odom_from_body: Array) -> None:
        """One more look, in which every fix has its vote for one of `candidates`, or begins one."""
        counts = self._spot.is_new(odom_from_body)
        begin_look(candidates, self._settings, is_elsewhere=counts)
        for fix, fresh in heard:
            vote(candidates, fresh, fix, odom_from_body if counts else None, self._settings)

    def weigh(self, heard: Heard, odom_from_body: Array) -> TimeSliced[None]:
        """One more look by which the candidates are judged; in slices."""
        self.hear(heard, self.places, odom_from_body)
        self.places = still_held(self.places, self._settings)
        self._told_apart = yield from disambiguated(self.places, self._settings)

    def standing(self) -> tuple[list[PoseHypothesis], list[PoseHypothesis]]:
        """The candidates, the likeliest first, and those of them that it may be as well."""
        likely, best = ranked(self.places), self._told_apart
        if not any(c is best for c in likely):  # it may have been dropped in a look that goes on
            return likely, rivals(self.places, self._settings)
        return sorted(likely, key=lambda c: c is not best), []

    def is_confirmed(self, candidate: PoseHypothesis, fixes: Sequence[Fix]) -> bool:
        """By fixes and way enough, or by one fix so strong, and alone of all places that were tried, that no other place of this map
        can be meant."""
        strong = len(self.places) == len(fixes) == 1 and is_unambiguous(fixes[0], self._settings)
        return strong or is_proven(candidate, self._settings)

    def moved_m(self, place: PoseHypothesis) -> float | None:
        """How far a place is from the one that was given up for it; None where its covariance had admitted as much."""
        if self._given_up is None:
            return None
        error = difference(place.now_map_from_body, self._given_up.now_map_from_body)
        covariance = place.now_cov + self._given_up.now_cov
        beyond = error @ np.linalg.solve(covariance, error) > self._settings.innovation_limit
        return float(np.linalg.norm(error[3:])) if beyond else None
