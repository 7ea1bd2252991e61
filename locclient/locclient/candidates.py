"""Places that fixes speak for before one of them is believed: who votes for which, who leads, who is a rival. Pure."""

from collections.abc import Sequence

import numpy as np

from locclient.anchors import Anchor, difference
from locclient.relocalizer import Fix
from locclient.settings import TrackSettings


def begin_look(candidates: Sequence[Anchor], settings: TrackSettings) -> None:
    """One more look at the map, in which none of them has been spoken for yet."""
    for candidate in candidates:
        candidate.misses += 1
        candidate.fade(settings.evidence_kept_share)


def vote(candidates: list[Anchor], fresh: Anchor, fix: Fix, settings: TrackSettings) -> None:
    """The place of a fix, carried to the present: a vote for the candidate that is there, which takes it over, or a new candidate."""
    for candidate in candidates:
        if _is_same_place(fresh, candidate, settings):
            if candidate.misses:  # at most one vote a frame
                candidate.support, candidate.misses = candidate.support + 1, 0
                candidate.speak(fix.inliers, fix.hit_share)
            candidate.moved_to(fresh)
            return
    fresh.fade(0.0)
    fresh.speak(fix.inliers, fix.hit_share)
    candidates.append(fresh)


def still_held(candidates: Sequence[Anchor], settings: TrackSettings) -> list[Anchor]:
    """Those that some recent look spoke for."""
    return [c for c in candidates if c.misses < settings.max_misses]


def ranked(candidates: Sequence[Anchor]) -> list[Anchor]:
    """The one that most speaks for first."""
    return sorted(candidates, key=lambda c: -c.evidence)


def rivals(candidates: Sequence[Anchor], settings: TrackSettings) -> list[Anchor]:
    """Candidates besides the best for which nearly as much speaks, look by look since they were thought of: as many inliers,
    or as many of the landmarks that should be seen there. A place where the map is thin is no less likely than its twin."""
    if not candidates:
        return []
    best, *others = ranked(candidates)
    return [
        c
        for c in others
        if c.inliers >= settings.rival_share * best.inliers
        or (c.hits >= settings.rival_hit_share * best.hits and c.inliers >= settings.rival_least_share * best.inliers)
    ]


def is_proven(candidate: Anchor, settings: TrackSettings) -> bool:
    """By fixes and way enough."""
    return candidate.support >= settings.confirming_fixes and candidate.travelled_m >= settings.confirming_distance_m


def is_unmistakable(fix: Fix, settings: TrackSettings) -> bool:
    """Whether a fix, alone of all places that were tried, is so strong that no other place of this map can be meant."""
    return (
        fix.inliers >= settings.strong_inliers
        and fix.share >= settings.strong_share
        and fix.twin_share < settings.strong_twin_share
    )


def _is_same_place(fresh: Anchor, candidate: Anchor, settings: TrackSettings) -> bool:
    error, covariance = difference(fresh.now_map_from_body, candidate.now_map_from_body), candidate.now_cov
    far_m = settings.hypothesis_distance_m + 3 * np.sqrt(np.trace(covariance[3:, 3:]))
    far_rad = np.radians(settings.hypothesis_angle_deg) + 3 * np.sqrt(np.trace(covariance[:3, :3]))
    return bool(np.linalg.norm(error[3:]) < far_m and np.linalg.norm(error[:3]) < far_rad)
