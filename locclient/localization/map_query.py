"""Map queries: their start, and their work spread over frames. Pure."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array, interpolate_se3, se3_inverse
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.relocalization.relocalizer import EarlierFrame, Fix, FrameFeatures, Relocalizer
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.time_sliced import TimeSliced
from locclient.localization.alias_disambiguation import ViewpointGate
from locclient.localization.held_maps import UNKNOWN_COV
from locclient.localization.image_quality import UNUSABLE
from locclient.localization.perception import Percept, QueryInput
from locclient.localization.pose_hypothesis import PoseHypothesis
from locclient.localization.pose_tracker import PoseTracker, QueryResult
from locclient.localization.settings import LocalizerSettings

_SPREAD_SHARE = 0.45  # of the query interval: if frames are farther apart, a query is not spread over frames
_HYPOTHESES_AT_ONCE = 3  # in one time slice of a search
# Per frame, where a late estimate does no harm: from an unchanged viewpoint, in the first searches without a prior, after lost tracks, and
# for a pose that is too vague.
_MORE_SLICES = 3
_TORN_SLICES = 2  # among places that the next looks may tell apart; three find the right one a fifteenth sooner
_COUNTERPART_M = 3.0  # around the place of a fix on another floor, whose map may lie so far off in the building
_FIRST_SEARCHES = 10  # then the robot probably drives where nothing is mapped, and keeps to the time of a frame


@dataclass(frozen=True)
class FinishedQuery:
    """A finished map query, with or without a fix; is_confirmed: the pose is confirmed."""

    frame: RectifiedFrame
    odometry: OdometryEstimate
    features: FrameFeatures
    fix: Fix | None
    relocalizer: Relocalizer
    is_confirmed: bool


class MapQuery:
    """Queries the map from time to time, with a slice of work in each frame.

        IDLE      --due by the interval, or at once after lost tracks-->   EXTRACT   features of that frame
        EXTRACT   --a pose is confirmed-->                                 NEAR      landmarks expected around it
        EXTRACT   --no pose is confirmed-->                                SEARCH    near candidates, then in the whole map or the prior
        NEAR      --no fix, as in earlier frames-->                        POOLED    landmarks of all those frames, around it
        NEAR, POOLED --no fix, repeatedly-->                               SEARCH
        any       --slices used up-->                                      continue with the next frame
        any       --version changes, forget, tracks are lost-->            IDLE, without a result
        NEAR, POOLED, SEARCH --done-->                                     IDLE, with fixes for the tracker

    failed: number of failed queries in a row.
    """

    def __init__(self, tracker: PoseTracker, settings: LocalizerSettings, cameras: int) -> None:
        """cameras: number of those of the rig."""
        self._tracker, self._maps, self._settings, self._track = tracker, tracker.maps, settings, settings.track
        self.view = 0  # whose frame is queried
        self.failed = 0
        self.finished: FinishedQuery | None = None  # finished with the last frame
        self.job: TimeSliced[QueryResult] | None = None  # under way
        self._begun: tuple[Percept, RectifiedFrame | None] | None = None  # the frame of that job, or of the last one
        self._begun_ns: int | None = None
        self._slices, self._is_urgent = 1, False  # of that job: slices per frame; started by lost tracks
        self._last_ns: int | None = None  # of the last frame
        self._gates = [ViewpointGate() for _ in range(cameras)]
        # Of each camera, by floor: searched without success from the viewpoint of the gate.
        self._failed_places: list[defaultdict[str, list[Array]]] = [defaultdict(list) for _ in range(cameras)]
        tracker.on_restart.append(self.forget)

    def begin_anew(self) -> None:
        """Cancel a running query: the maps have changed."""
        self._cancel()
        self._failed_places = [defaultdict(list) for _ in self._gates]

    def forget(self) -> None:
        """Forget the pose; cancel a running query."""
        self.begin_anew()
        self.failed = 0

    def _cancel(self) -> None:
        self.job = None
        self._tracker.end_query()

    def step(self, percept: Percept, frame: RectifiedFrame | None, *, is_riding: bool = False) -> QueryResult:
        """Return the result of a query finished with this frame, with the stamp of the query's frame; otherwise an empty result.

        Queries are spread over frames, except the first one, those after a gap, and those of recordings with hardly more frames
        than queries. frame: None in a replay, where queries begin at the recorded frames. is_riding: in a lift, whose cabin looks the same
        everywhere.
        """
        self.finished = None
        if percept.odometry.new_odom_from_old_odom is not None:
            for gate in self._gates:
                gate.redefine_odom(percept.odometry.new_odom_from_old_odom)
        if is_riding:
            self.forget()
            result = QueryResult(refused="the robot rides in a lift")
        else:
            refused = QueryResult(refused=percept.calibration.text)
            result = refused if percept.is_reversed else self._step(percept, frame)
        self._last_ns = percept.odometry.stamp_ns
        return result

    def _step(self, percept: Percept, frame: RectifiedFrame | None) -> QueryResult:
        odometry, is_at_once = percept.odometry, False
        is_urgent = percept.has_broken and not self.failed
        if (is_urgent and not self._is_urgent) or odometry.after_gap:
            self._cancel()  # a frame before the break, or before the gap, says little of the robot's present pose
        if self.job is None and self._maps.by_floor:
            begins = percept.query is not None if frame is None else is_urgent or self._is_due(odometry)
            if begins:
                is_at_once = self._is_sparse(odometry.stamp_ns) or odometry.after_gap
                self._begin(percept, frame, is_urgent=is_urgent)
        return self._advance(is_at_once=is_at_once)

    def _is_due(self, odometry: OdometryEstimate) -> bool:
        confirmed, last_ns, track = self._tracker.confirmed, self._begun_ns, self._track
        support = 0 if confirmed is None else confirmed.support
        is_settled = odometry.inertial and not self.failed and support >= track.settled_fixes
        interval_s = max(track.fix_interval_s, track.settled_interval_s) if is_settled else track.fix_interval_s
        return last_ns is None or odometry.after_gap or (odometry.stamp_ns - last_ns) * 1e-9 >= 0.999 * interval_s

    def _is_sparse(self, stamp_ns: int) -> bool:
        """Return True if there are too few frames to spread a query over."""
        if self._begun_ns is None or self._last_ns is None:
            return True
        return (stamp_ns - self._last_ns) * 1e-9 > _SPREAD_SHARE * self._track.fix_interval_s

    def _motion_until(self, odometry: OdometryEstimate, stamp_ns: int) -> Array | None:
        """Return the body's motion (4, 4) now_from_then from a moment to the present frame, at its speed; None if they are the same."""
        later_ns, before, last_ns = stamp_ns - odometry.stamp_ns, odometry.previous_from_body, self._last_ns
        if later_ns == 0 or before is None or last_ns is None:
            return None
        return interpolate_se3(np.eye(4), before, later_ns / (odometry.stamp_ns - last_ns))

    def _begin(self, percept: Percept, frame: RectifiedFrame | None, *, is_urgent: bool) -> None:
        odometry, tracker = percept.odometry, self._tracker
        if percept.query is None:
            assert frame is not None
            # The last one as long as it gives fixes, else the next one with good images.
            count, first = len(self._gates), self.view + bool(self.failed)
            order = [(first + k) % count for k in range(count)]
            chosen = next((k for k in order if percept.view_causes[k] not in UNUSABLE), self.view)
            percept.query = QueryInput(view=chosen)
        self.view = view = percept.query.view
        frame = None if frame is None else frame.view(view) or frame
        self._begun = percept, frame
        tracker.begin_query(odometry, view, None if frame is None else self._motion_until(odometry, frame.stamp_ns))
        self._begun_ns = odometry.stamp_ns
        is_at_rest = tracker.confirmed is None and not self._gates[view].is_new(odometry.odom_from_body)
        is_unknown = tracker.confirmed is None and tracker.prior is None
        is_wide = (
            tracker.confirmed is not None
            and radius_95_m(tracker.confirmed.now.cov_rot_trans) > self._track.degraded_radius_m
        )
        is_eager = is_at_rest or is_urgent or is_wide or (is_unknown and self.failed < _FIRST_SEARCHES)
        is_torn = self._track.is_whole_site_mapped and len(tracker.candidates.hypotheses) > 1
        few = _TORN_SLICES if is_torn and tracker.confirmed is None else 1
        self._is_urgent, self._slices = is_urgent, _MORE_SLICES if is_eager else few
        if not is_at_rest:
            self._failed_places[view].clear()
        self.job = self._run(percept.query, frame, is_sparse=self._is_sparse(odometry.stamp_ns))

    def _advance(self, *, is_at_once: bool) -> QueryResult:
        if self.job is None:
            return QueryResult()
        try:
            for _ in range(self._slices):
                next(self.job)
            while is_at_once:
                next(self.job)
        except StopIteration as done:
            result: QueryResult = done.value._replace(fix_stamp_ns=self._begun_ns)
            self._cancel()
            self._is_urgent = False
            self.failed = 0 if result.fix is not None else self.failed + 1
            assert self._begun is not None
            percept, frame = self._begun
            if frame is not None and percept.query is not None and percept.query.features is not None:
                is_confirmed = self._tracker.confirmed is not None
                floor = self._tracker.floor if result.fix is None else result.fix.floor
                relocalizer = self._on(floor) or self._any_relocalizer()
                looked = percept.odometry, percept.query.features, result.fix, relocalizer, is_confirmed
                self.finished = FinishedQuery(frame, *looked)
            return result
        return QueryResult()

    def _on(self, floor: str) -> Relocalizer | None:
        """Return the relocalizer of the queried view on a floor; None if the robot does not hold its map."""
        held = self._maps.by_floor.get(floor)
        return None if held is None else held.relocalizers[self.view]

    def _any_relocalizer(self) -> Relocalizer:
        return next(iter(self._maps.by_floor.values())).relocalizers[self.view]

    def _run(self, query: QueryInput, frame: RectifiedFrame | None, *, is_sparse: bool) -> TimeSliced[QueryResult]:
        tracker = self._tracker
        features = yield from _extract(query, frame, self._any_relocalizer())
        confirmed = tracker.confirmed
        if confirmed is None:
            tracker.forget_frames()
            fixes, outside = yield from self._search(features)
            is_one_map = len(self._floors_of_prior()) <= 1
            return (yield from tracker.update_candidates(fixes, outside=outside, is_one_map=is_one_map))
        near = self._near(features, confirmed)
        if near is None and (earlier := tracker.earlier_frames()):
            yield
            near = self._near(features, confirmed, earlier)
        if near is None:
            tracker.keep_frame(features)
        else:
            tracker.forget_frames()
        fixes = [] if near is None else [near]
        if near is None and (is_sparse or self.failed + 1 >= self._track.search_after_failed):
            yield
            if (relocalizer := self._on(confirmed.now.floor)) is not None:
                found = yield from relocalizer.anywhere(features, None, self._rotation(confirmed))
                fixes = [fix for fix in found if fix.inliers >= self._settings.fix.min_inliers]
        return tracker.update(fixes, confirmed, is_near=near is not None)

    def _near(
        self, features: FrameFeatures, hypothesis: PoseHypothesis, earlier: Sequence[EarlierFrame] = ()
    ) -> Fix | None:
        """Return the fix near a hypothesis at the frame of the query, by that frame and earlier ones."""
        relocalizer = self._on(hypothesis.now.floor)
        if relocalizer is None:
            return None
        place = self._maps.with_error(hypothesis.then, most=UNKNOWN_COV).of_point(self._tracker.body_from_cam)
        return relocalizer.near(features, place.map_from_body, place.cov_rot_trans, earlier)

    def _rotation(self, hypothesis: PoseHypothesis) -> Array:
        return (hypothesis.then.map_from_body @ self._tracker.body_from_cam)[:3, :3]

    def _floors_of_prior(self) -> list[str]:
        """Return the floors to search."""
        prior = self._tracker.prior
        return [floor for floor in self._maps.by_floor if prior is None or floor in prior.floors]

    def _search(self, features: FrameFeatures) -> TimeSliced[tuple[list[Fix], bool]]:
        """Return fixes in all maps, or within the prior; near the candidates first. True if some lie outside the prior."""
        tracker, found = self._tracker, list[Fix]()
        candidates = tracker.candidates.hypotheses
        for number, candidate in enumerate(candidates, start=1):
            fix = self._near(features, candidate)
            if fix is not None:
                found.append(fix)
            if number % _HYPOTHESES_AT_ONCE == 0:
                yield
        only = candidates[0] if len(candidates) == 1 else None
        prior, fixes, floors = tracker.prior, list[Fix](), self._floors_of_prior()
        for floor in floors:
            relocalizer = self._maps.by_floor[floor].relocalizers[self.view]
            near = None if prior is None else prior.is_near(relocalizer.view.map_from_cam[:, :3, 3], floor)
            rotation = self._rotation(only) if only is not None and only.now.floor == floor else None
            here, failed = [fix for fix in found if fix.floor == floor], self._failed_places[self.view][floor]
            fixes += yield from relocalizer.anywhere(features, near, rotation, here, failed)
        fixes += yield from self._counterparts(features, fixes, floors)
        fixes = tracker.believed(sorted(fixes, key=lambda fix: -fix.inliers))
        prior = tracker.prior
        if prior is None:
            return fixes, False
        within = [fix for fix, at in tracker.observations(fixes) if prior.is_compatible(at.now)]
        if prior.is_measured and within and within[0].inliers < self._track.competitor_share * fixes[0].inliers:
            within = []  # what looks a little like this place is elsewhere
        if within or not prior.is_revisable:
            # An operator may have chosen an alias of the place.
            is_open = prior.is_revisable and not prior.is_measured
            return fixes if is_open else within, len(within) < len(fixes)
        yield
        fixes = []
        for held in self._maps.by_floor.values():
            fixes += yield from held.relocalizers[self.view].anywhere(features)
        fixes = [fix for fix in sorted(fixes, key=lambda fix: -fix.inliers) if tracker.is_reliable(fix)]
        return fixes if tracker.drops_prior(fixes) else [], bool(fixes)

    def _counterparts(
        self, features: FrameFeatures, fixes: Sequence[Fix], floors: Sequence[str]
    ) -> TimeSliced[list[Fix]]:
        """Return fixes at the places above and below the best fix of each floor that have none yet: floors may look alike, and a search
        that fails on the robot's own must not leave another one without competitors."""
        added: list[Fix] = []
        known = self._maps.plan_from_map
        for floor, other in permutations(floors, 2):
            best = next((fix for fix in fixes if fix.floor == floor), None)
            if best is None or not {floor, other} <= known.keys():
                continue
            place = se3_inverse(known[other]) @ known[floor] @ best.map_from_cam
            here = [fix for fix in (*fixes, *added) if fix.floor == other]
            if any(np.linalg.norm(fix.map_from_cam[:2, 3] - place[:2, 3]) < _COUNTERPART_M for fix in here):
                continue
            there = self._maps.by_floor[other].relocalizers[self.view]
            near = np.linalg.norm(there.view.map_from_cam[:, :2, 3] - place[:2, 3], axis=1) < _COUNTERPART_M
            yield
            new = yield from there.anywhere(features, near, place[:3, :3], here)
            added += [fix for fix in new if not any(fix.map_from_cam is each.map_from_cam for each in here)]
        return added


def _extract(query: QueryInput, frame: RectifiedFrame | None, relocalizer: Relocalizer) -> TimeSliced[FrameFeatures]:
    """Return the features of a frame and store them in `query`; without a frame, the stored ones, in as many slices."""
    if frame is None:
        for _ in range(query.slices):
            yield
        if query.features is None:
            raise RecordingError("a map query ends before its features are available; was the file made by a robot?")
        return query.features
    work = relocalizer.extract(frame)
    while True:
        try:
            next(work)
        except StopIteration as done:
            query.features = done.value
            return query.features
        query.slices += 1
        yield
