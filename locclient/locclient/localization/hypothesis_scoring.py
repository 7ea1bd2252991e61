"""Places that fixes speak for before one of them is believed: who votes for which, who leads, who is a rival. Pure."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.relocalization.relocalizer import Fix, TimeSliced
from locclient.localization.alias_disambiguation import evidence, mark_shared
from locclient.localization.pose_hypothesis import PoseHypothesis, difference
from locclient.localization.settings import TrackSettings

_PAIRS_AT_ONCE = 4  # comparisons in a slice of a look


def begin_look(candidates: Sequence[PoseHypothesis], settings: TrackSettings, *, is_elsewhere: bool) -> None:
    """One more look at the map, in which none of them has been spoken for yet; is_elsewhere: from another spot than the last."""
    for candidate in candidates:
        candidate.misses += 1
        candidate.fade(settings.evidence_kept_share)
        if is_elsewhere:
            candidate.tally.begin_look()


def vote(
    candidates: list[PoseHypothesis],
    fresh: PoseHypothesis,
    fix: Fix,
    odom_from_body: Array | None,
    settings: TrackSettings,
) -> None:
    """The place of a fix, carried to the present: a vote for the candidate that is there, which takes it over, or a new candidate.

    odom_from_body: at present, None where the look is from the same spot as the last one and its landmarks are not counted.
    """
    for candidate in candidates:
        if _is_same_place(fresh, candidate, settings):
            if candidate.misses:  # at most one vote a frame
                candidate.support, candidate.misses = candidate.support + 1, 0
                candidate.speak(fix.inliers, fix.landmark_recall)
                _count(candidate, fresh, fix, odom_from_body, settings)
            candidate.moved_to(fresh)
            return
    fresh.fade(0.0)
    fresh.speak(fix.inliers, fix.landmark_recall)
    _count(fresh, fresh, fix, odom_from_body, settings)
    candidates.append(fresh)


def still_held(candidates: Sequence[PoseHypothesis], settings: TrackSettings) -> list[PoseHypothesis]:
    """Those that some recent look spoke for."""
    return [c for c in candidates if c.misses < settings.max_misses]


def ranked(candidates: Sequence[PoseHypothesis]) -> list[PoseHypothesis]:
    """The one that most speaks for first."""
    return sorted(candidates, key=lambda c: -c.evidence)


def rivals(
    candidates: Sequence[PoseHypothesis], settings: TrackSettings, best: PoseHypothesis | None = None
) -> list[PoseHypothesis]:
    """Candidates besides the best for which nearly as much speaks, look by look since they were thought of: as many inliers,
    or as many of the landmarks that should be seen there. A place where the map is thin is no less likely than its twin."""
    if not candidates:
        return []
    best = best or ranked(candidates)[0]
    return [
        c
        for c in candidates
        if c is not best
        and (
            c.inliers >= settings.rival_share * best.inliers
            or (
                c.hits >= settings.rival_hit_share * best.hits
                and c.inliers >= settings.rival_least_share * best.inliers
            )
        )
    ]


def disambiguated(candidates: Sequence[PoseHypothesis], settings: TrackSettings) -> TimeSliced[PoseHypothesis | None]:
    """The one that what stands there tells from every other that totals would name its rival; None while nothing does. In slices.

    It need not be the one that totals rank first: a sign is little beside all that the places share. Only where the right one must be
    among them: of the twins of a place that the map does not hold, one is always the least unlike it.
    """
    if not settings.is_whole_site_mapped or not rivals(candidates, settings):
        return None
    places = ranked(candidates)
    shared = [np.zeros(len(c.tally.ids), bool) for c in places]
    for number, (i, j) in enumerate(combinations(range(len(places)), 2)):
        if number and number % _PAIRS_AT_ONCE == 0:
            yield
        mark_shared(places[i].tally, places[j].tally, shared[i], shared[j])
    known = {id(c): (c.tally, flags) for c, flags in zip(places, shared, strict=True)}

    def lead(one: PoseHypothesis, other: PoseHypothesis) -> float:
        (tally, flags), (other_tally, other_flags) = known[id(one)], known[id(other)]
        return evidence(tally, other_tally, flags, other_flags)

    yield
    best = max(places[1:], key=lambda other: lead(other, places[0]))
    if lead(best, places[0]) < settings.telling_evidence:
        best = places[0]
    for number, other in enumerate(rivals(candidates, settings, best)):
        if number and number % _PAIRS_AT_ONCE == 0:
            yield
        if lead(best, other) < settings.telling_evidence:
            return None
    return best


def is_proven(candidate: PoseHypothesis, settings: TrackSettings) -> bool:
    """By fixes and way enough."""
    return candidate.support >= settings.confirming_fixes and candidate.travelled_m >= settings.confirming_distance_m


def is_unambiguous(fix: Fix, settings: TrackSettings) -> bool:
    """Whether a fix, alone of all places that were tried, is so strong that no other place of this map can be meant."""
    return (
        fix.inliers >= settings.strong_inliers
        and fix.inlier_share >= settings.strong_share
        and fix.alias_ratio < settings.strong_twin_share
    )


def _count(
    candidate: PoseHypothesis, fresh: PoseHypothesis, fix: Fix, odom_from_body: Array | None, settings: TrackSettings
) -> None:
    if settings.is_whole_site_mapped and fix.covisible is not None and odom_from_body is not None:
        candidate.tally.look(odom_from_body @ se3_inverse(fresh.now_map_from_body), fix.covisible)


def _is_same_place(fresh: PoseHypothesis, candidate: PoseHypothesis, settings: TrackSettings) -> bool:
    error, covariance = difference(fresh.now_map_from_body, candidate.now_map_from_body), candidate.now_cov
    far_m = settings.hypothesis_distance_m + 3 * np.sqrt(np.trace(covariance[3:, 3:]))
    far_rad = np.radians(settings.hypothesis_angle_deg) + 3 * np.sqrt(np.trace(covariance[:3, :3]))
    return bool(np.linalg.norm(error[3:]) < far_m and np.linalg.norm(error[:3]) < far_rad)
