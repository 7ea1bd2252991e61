"""Test whether a session belongs to a site, and its pose there: joined, foreign, or undecided, at a stated error rate. Pure.

Fixes at several places whose relative motion agrees with the session's own give possible poses. There two hypotheses are tested by
the seen share of the expected parts of the map: that it was recorded elsewhere, where it sees at most what similar halls
have in common, and that it belongs to the site, of which the greater part still exists. Position priors widen the search around their
poses, choose between similar places of the site, and reject a session that they contradict; they are not evidence that it
belongs to the site. Only with them is a session called foreign: without, the place may be another one of the same site, surveyed in the
other direction or not at all, as similar to the map's as one of another building.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from fleetmap.failure_definition import is_wrong
from fleetmap.geometry import Array, Indices, Mask
from fleetmap.relocalization.map_view import places_around
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.merge import session_alignment
from mapserver.survey.merge.confirmation import Confirmation, confirmation, look
from mapserver.survey.merge.session_alignment import Alignment, Images
from mapserver.survey.pose_graph.graph_marginals import GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.settings import SessionSettings

_REMAINING_SHARE = 0.5  # of the expected cells: a map of which the greater part has changed needs a new survey
# Seen share of another building's map: in pictures of twelve pairs of halls of one layout, with fixes at each place, 0.25 to 0.39 of
# the cells (ground marks, beams, columns, lamps)
_SHARED_SHARE = 0.4
_MIN_BLOCKS = 8  # of 1.5 m: two walls of 3 m x 3 m
_MOST_PLACES, _MOST_LOOKS = 4, 240  # compared alignments, keyframes used
_SAME_PLACE_M = 1.2
_BESIDE_M, _BESIDE_COSINE = 2.0, 0.8  # limits of distance and heading to a place of the map, to be located there
_PRIOR_M = 3.0  # limit between an alignment and the position priors
_DRIVE_ON = "drive a longer way through places that are in the map, the same way round"


class MembershipVerdict(StrEnum):
    """Outcomes of the test."""

    JOINED = "joined"
    FOREIGN = "foreign"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class MembershipEvidence:
    """Figures of the test.

    fixes: keyframes whose fixes agree with the session's own motion; places: number of those a metre apart. cells_expected, cells_seen:
    expected and seen parts of the map; seen_share with its bounds share_low, share_high at error_rate. competitor_share: the same share at
    the most similar other place, None without one. priors_off_m: distance between the place and the position priors, None without any.
    """

    fixes: int = 0
    places: int = 0
    cells_expected: int = 0
    cells_seen: int = 0
    seen_share: float = 0.0
    share_low: float = 0.0
    share_high: float = 1.0
    error_rate: float = 0.0
    competitor_share: float | None = None
    priors_off_m: float | None = None


@dataclass(frozen=True, slots=True)
class Membership:
    """A session that is not joined: reason and evidence."""

    reason: str
    verdict: MembershipVerdict = MembershipVerdict.UNDECIDED
    evidence: MembershipEvidence = MembershipEvidence()


@dataclass(frozen=True, slots=True)
class SessionPlace:
    """A session's pose: map_from_body (K, 4, 4) of its keyframes, the agreeing fixes and how many were accepted, and what it sees there."""

    map_from_body: Array
    placed: Alignment
    believed: int
    seen: Confirmation
    priors_off_m: float | None
    competitor_share: float | None = None

    @property
    def is_where_priors_say(self) -> bool:
        return self.priors_off_m is not None and self.priors_off_m < _PRIOR_M

    @property
    def figures(self) -> str:
        return f"of {self.seen.cells} parts of the map expected there it sees {self.seen.seen}"

    @property
    def evidence(self) -> MembershipEvidence:
        return MembershipEvidence(
            fixes=len(self.placed.fixes),
            places=self.placed.places,
            cells_expected=self.seen.cells,
            cells_seen=self.seen.seen,
            seen_share=round(self.seen.share, 4),
            share_low=round(self.seen.low, 4),
            share_high=round(self.seen.high, 4),
            error_rate=self.seen.error_rate,
            competitor_share=self.competitor_share,
            priors_off_m=self.priors_off_m,
        )

    def held(self, reason: str, verdict: MembershipVerdict = MembershipVerdict.UNDECIDED) -> Membership:
        """Return that the session is not joined there."""
        return Membership(reason, verdict, self.evidence)


@dataclass(frozen=True)
class SessionKeyframes:
    """Input of the test: a session.

    images of each keyframe by the cameras at body_from_cams (V, 4, 4), with their features and depths; survey_from_body (K, 4, 4) and the
    edges of its motion; camera: of all images. map_from_survey: pose by position priors,
    None without any. pieces (K,): equal for keyframes that pictures link, not odometry alone; None if they link all.
    """

    images: Images
    survey_from_body: Array
    chain: Sequence[PoseEdge]
    camera: StereoCamera
    body_from_cams: Array
    map_from_survey: Array | None = None
    pieces: Indices | None = None

    @property
    def by_priors(self) -> Array | None:
        """(K, 4, 4) map_from_body of the keyframes by position priors."""
        return None if self.map_from_survey is None else self.map_from_survey @ self.survey_from_body


class MembershipTest:
    """The test of one session in one map."""

    def __init__(
        self, relocalizer: Relocalizer, firm: Mask, session: SessionKeyframes, settings: SessionSettings
    ) -> None:
        """firm (N,): landmarks of the relocalizer's view that are expected to be seen again."""
        self._relocalizer, self._firm, self._session, self._settings = relocalizer, firm, session, settings
        self.tried = 0

    def locate(self) -> SessionPlace | Membership:
        """Return the session's pose if fixes give one, no other is similar, and its view of the map does not contradict it there."""
        session, settings, by_priors = self._session, self._settings, self._session.by_priors
        ks = _spread(range(len(session.survey_from_body)), settings.fix_keyframes)
        if by_priors is not None:  # plus as many that priors put near a place of the map
            beside = np.flatnonzero(self._beside_the_map(by_priors).any(axis=1)).tolist()
            ks = sorted({*ks, *_spread(beside, settings.fix_keyframes)})
        fixes = session_alignment.find_fixes(self._relocalizer, session.images, ks, session.body_from_cams, by_priors)
        self.tried = len(ks)
        found = session_alignment.alignments(
            fixes, session.survey_from_body, GraphMarginals(session.survey_from_body, session.chain)
        )
        enough = [p for p in found if len(p.fixes) >= settings.min_fixes and p.places >= settings.min_places]
        if not enough:
            most = found[0] if found else Alignment((), np.eye(4), 0)
            return Membership(
                f"it was not found in the map: at most {len(most.fixes)} fixes of {len(ks)} keyframes at {most.places} places agree "
                f"on its pose, {settings.min_fixes} at {settings.min_places} are needed; {_DRIVE_ON}",
                evidence=MembershipEvidence(len(most.fixes), most.places, error_rate=settings.join_error_rate),
            )
        # At the priors' pose there may be few fixes: most of it is new, and a similar place in the map may have more.
        places = []
        for placed in sorted(enough, key=self._is_elsewhere_by_priors)[:_MOST_PLACES]:
            map_from_body, believed = session_alignment.follow_fixes(placed, session.survey_from_body, session.chain)
            apart_m = self._priors_off_m(placed, map_from_body)
            priors_off_m = None if apart_m is None else round(apart_m, 2)
            seen = self.confirmation(map_from_body)
            places.append(SessionPlace(map_from_body, placed, believed, seen, priors_off_m))
        chosen = self._chosen(places)
        if isinstance(chosen, Membership):
            return self._broken(max(places, key=lambda one: len(one.placed.fixes)), found) or chosen
        held = self._broken(chosen, found)
        if held is None and contradicts(chosen.seen):
            held = self.judged(chosen)
        return held or chosen

    def _broken(self, chosen: SessionPlace, found: Sequence[Alignment]) -> Membership | None:
        """Return why a session is held of which some keyframes agree on another place than its own motion gives them.

        They may stand at a place that looks like that one. Not so if no picture links them to the others, or the map contradicts them
        where they are: then the motion in between is wrong, by a slip, a lift or wrong stamps.
        """
        session, own = self._session, {fix.k for fix in chosen.placed.fixes}
        pieces = np.zeros(len(session.survey_from_body)) if session.pieces is None else session.pieces
        linked = np.isin(pieces, pieces[sorted(own)])
        for other in found:
            ks = sorted({fix.k for fix in other.fixes} - own)
            places = session_alignment.count_places(session.survey_from_body[ks, :3, 3])
            if len(ks) < self._settings.min_fixes or places < self._settings.min_places:
                continue
            there = other.map_from_survey @ session.survey_from_body[ks]
            off_m = float(np.median(np.linalg.norm((there - chosen.map_from_body[ks])[:, :3, 3], axis=1)))
            is_alias = linked[ks].all() and not contradicts(self.confirmation(chosen.map_from_body, ks))
            if is_alias or not is_wrong(off_m):  # the joint adjustment takes up less
                continue
            return chosen.held(
                f"its motion is broken: {len(ks)} of its keyframes, the first after {ks[0] / len(linked):.0%} of them, agree on a place "
                f"{off_m:.1f} m from where it puts them; it slipped, was lifted, or its stamps are wrong: drive again, or build its parts "
                "alone, with --frames"
            )
        return None

    def _beside_the_map(self, map_from_body: Array) -> Mask:
        """Return which images (K, V) of keyframes at map_from_body (K, 4, 4) are near a place of the map, with a similar heading."""
        places, looking = self._relocalizer.view.map_from_cam, map_from_body[:, None] @ self._session.body_from_cams
        beside = [places_around(places, at, _BESIDE_M, _BESIDE_COSINE).any() for at in looking.reshape(-1, 4, 4)]
        return np.reshape(beside, looking.shape[:2])

    def _priors_off_m(self, placed: Alignment, map_from_body: Array) -> float | None:
        """Return the distance of the keyframes with fixes from their priors, at map_from_body (K, 4, 4); None without priors."""
        if self._session.by_priors is None:
            return None
        ks = [fix.k for fix in placed.fixes]
        return float(np.median(np.linalg.norm((map_from_body - self._session.by_priors)[ks, :3, 3], axis=1)))

    def _is_elsewhere_by_priors(self, placed: Alignment) -> bool:
        off_m = self._priors_off_m(placed, placed.map_from_survey @ self._session.survey_from_body)
        return off_m is None or off_m >= _PRIOR_M

    def confirmation(self, map_from_body: Array, chosen: Sequence[int] | None = None) -> Confirmation:
        """Return the share of the map seen by the session with its keyframes, or chosen ones, at map_from_body (K, 4, 4).

        Only images near places of the map are used: parts of the next aisle that a survey saw through gaps in the racks
        may be hidden by other goods from within that aisle. Without any near ones all are used, with few expected landmarks.
        """
        session, view = self._session, self._relocalizer.view
        beside = self._beside_the_map(map_from_body)
        asked = np.isin(np.arange(len(beside)), range(len(beside)) if chosen is None else chosen)[:, None]
        beside = beside & asked if (beside & asked).any() else np.broadcast_to(asked, beside.shape)
        looks = [
            look(view, session.camera, session.images[k][c], map_from_body[k] @ session.body_from_cams[c])
            for k in _spread(np.flatnonzero(beside.any(axis=1)).tolist(), _MOST_LOOKS // beside.shape[1])
            for c in np.flatnonzero(beside[k]).tolist()
        ]
        return confirmation(view.points_map, looks, self._firm, self._settings.join_error_rate)

    def judged(self, place: SessionPlace) -> Membership | None:
        """Return why a session with the confirmation there is not joined; None if it is."""
        seen = place.seen
        if _speaks_for_itself(seen):
            return None
        if not contradicts(seen):
            bounds = f"{seen.low:.0%} to {seen.high:.0%} where more than {_SHARED_SHARE:.0%} certainly, and half in total, are needed"
            return place.held(f"it is not certain that it belongs here: {place.figures}, {bounds}; {_DRIVE_ON}")
        figures = f"{place.figures}, at most {seen.high:.0%} where half is needed"
        if place.priors_off_m is None:
            return place.held(
                f"the most similar place is not its own: {figures}; it was recorded elsewhere, or where or in a direction in which "
                "the map was not: drive past a dock, the same way round as the survey, or build it as another --site"
            )
        reason = f"it was recorded elsewhere, or all has changed: {figures}; build it as another --site"
        return place.held(reason, MembershipVerdict.FOREIGN)

    def _chosen(self, found: list[SessionPlace]) -> SessionPlace | Membership:
        """Return the pose with the most evidence; undecided if another is as good and no position prior distinguishes them."""
        ranked = sorted(found, key=lambda one: (one.seen.cells - 2 * one.seen.seen, -len(one.placed.fixes)))
        best, *others = [
            one for n, one in enumerate(ranked) if not any(_same_place(one, other) for other in ranked[:n])
        ]
        alike = [best, *(one for one in others if one.seen.high >= max(_SHARED_SHARE, best.seen.low))]
        near = [one for one in alike if one.is_where_priors_say]
        if not near:  # for a drive with new aisles its own place may show less than a similar one elsewhere
            near = [one for one in others if one.is_where_priors_say and _speaks_for_itself(one.seen)]
            alike = [best, *near] if len(near) == 1 else alike
        chosen = near[0] if len(alike) > 1 and len(near) == 1 else best
        competitor_share = max((round(one.seen.share, 4) for one in others), default=None)
        chosen = replace(chosen, competitor_share=competitor_share)
        if len(alike) > 1 and len(near) != 1:
            seen = " and ".join(f"{one.seen.seen} of {one.seen.cells}" for one in alike[:2])
            return chosen.held(
                f"{len(alike)} places of the map look alike: it sees {seen} parts of the map there; drive on to where they "
                "differ, or past a dock"
            )
        if chosen.priors_off_m is None or chosen.is_where_priors_say:
            return chosen
        if contradicts(chosen.seen):
            return chosen.held(
                f"it was not found where its docks are, and the most similar place, {chosen.priors_off_m:.1f} m from there, is "
                f"not its own: {chosen.figures}; {_DRIVE_ON}, or build it as another --site"
            )
        return chosen.held(
            f"its docks and its view of the map give places {chosen.priors_off_m:.1f} m apart: correct the docks' positions, or leave "
            "them out"
        )


def _spread(keyframes: Sequence[int], most: int) -> list[int]:
    """Return at most `most` of them, evenly chosen."""
    return list(keyframes[:: max(1, -(-len(keyframes) // most))])


def _speaks_for_itself(seen: Confirmation) -> bool:
    """True if certainly more is seen than another building would show, and half of the map or more."""
    return seen.blocks >= _MIN_BLOCKS and seen.low > _SHARED_SHARE and seen.share >= _REMAINING_SHARE


def contradicts(seen: Confirmation) -> bool:
    """True if the session's view certainly contradicts the place."""
    return seen.blocks >= _MIN_BLOCKS and seen.high < _REMAINING_SHARE


def _same_place(one: SessionPlace, other: SessionPlace) -> bool:
    apart_m = np.linalg.norm((one.map_from_body - other.map_from_body)[:, :3, 3], axis=1)
    return bool(np.median(apart_m) < _SAME_PLACE_M)
