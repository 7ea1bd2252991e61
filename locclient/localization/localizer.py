"""The localizer: samples and tiles in, one estimate for each frame out. Pure."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.bow import Vocabulary
from fleetmap.geometry import Array, se3_inverse
from fleetmap.mapformat import Tile
from fleetmap.messages import Cause, Status
from fleetmap.numerics.time_sliced import TimeSliced
from fleetmap.odometry import OdometryEstimate, OdometryStatus, is_away
from fleetmap.relocalization.frame_features import FrameFeatures
from fleetmap.relocalization.map_view import LookAlikes, MapView
from fleetmap.relocalization.relocalizer import Fix, Relocalizer, is_reliable
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import ImuSamples, PositionPrior, WheelSample
from locclient.localization.alias_disambiguation import ViewpointGate
from locclient.localization.calibration.monitor import FinishedQuery
from locclient.localization.calibration.pair_order import REVERSED_TEXT
from locclient.localization.estimate import Estimate, LocalizationState, QueryResult, assemble
from locclient.localization.hypothesis_set import HypothesisSet, Observations, recent
from locclient.localization.initial_pose_prior import InitialPosePrior, agrees
from locclient.localization.perception import Perception, SensorPerception
from locclient.localization.pose_covariance import innovation_of, kalman_update, transport_cov
from locclient.localization.pose_hypothesis import PoseHypothesis
from locclient.localization.settings import LocalizerSettings

_SPREAD_SHARE = 0.45  # of the interval of map queries: at a lower frame rate a query is not spread over frames
_HYPOTHESES_AT_ONCE = 3  # in one time slice of a search
_MORE_SLICES = 3  # in a frame: of a search where the last one began too, as a late estimate costs nothing there, and where tracks broke
_OWN_FIX_M = 0.3  # between a fix and the hypothesis that it supports


@dataclass(frozen=True, slots=True)
class Start:
    """What a localizer begins with: by default it searches for itself.

    map_from_body (4, 4), cov_rot_trans (6, 6): the pose at frame `frame_index` of the odometry, None without one. is_confirmed: by fixes,
    of which stamp_ns and support are; else by a prior, with its is_revisable and travelled_m, the distance since it came. has_broken:
    tracks broke since. was_tracking: the robot has known its pose before. failed_queries: the last so many map queries found nothing.
    """

    frame_index: int = 0
    stamp_ns: int = 0
    support: int = 0
    map_from_body: Array | None = None
    cov_rot_trans: Array | None = None
    is_confirmed: bool = False
    is_revisable: bool = False
    travelled_m: float = 0.0
    has_broken: bool = False
    was_tracking: bool = False
    failed_queries: int = 0


class Localizer:
    """Localizes one robot in one map version; a new version is taken over without losing the pose."""

    def __init__(
        self,
        calibration: RigCalibration,
        camera: StereoCamera,
        body_from_cam: Array,
        imu_minus_cam_s: float,
        settings: LocalizerSettings,
        clock: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """`clock` (seconds) measures the stages; the default measures nothing."""
        self._clock = clock
        self._settings, self._track = settings, settings.track
        self._camera, self._body_from_cam = camera, body_from_cam
        self._cam_from_body = se3_inverse(body_from_cam)
        self._base_from_body = calibration.base_from_body
        rig = (calibration, camera, body_from_cam, imu_minus_cam_s)
        self.perception: Perception = SensorPerception(*rig, settings)
        self._relocalizer: Relocalizer | None = None
        self._map_version: int | None = None
        self._lookalikes: LookAlikes | None = None
        self._prior: InitialPosePrior | None = None
        self._confirmed: PoseHypothesis | None = None
        self._candidates = HypothesisSet(settings.track)  # while none is confirmed
        self._last_odom_from_body: Array | None = None
        self._last_ns: int | None = None
        self._query_ns: int | None = None  # of the last map query's frame
        self._work: TimeSliced[QueryResult] | None = None  # the query that goes on
        self._query_frame: PoseHypothesis | None = None  # the frame of that query, as the identity
        self._failed_queries = 0
        self._failed_places: list[Array] = []  # tried in vain from the viewpoint of the gate
        self._search_gate = ViewpointGate()
        self._slices, self._is_urgent = 1, False  # of the query that goes on: in a frame; it began where tracks broke
        self._was_tracking = False
        self._query_input: tuple[RectifiedFrame, OdometryEstimate] | None = None  # of that query
        self._query_features: FrameFeatures | None = None

    def handle_imu(self, samples: ImuSamples) -> None:
        """IMU samples newer than any before."""
        self.perception.handle_imu(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        """Wheel odometry newer than any before."""
        self.perception.handle_wheel(samples)

    def handle_prior(self, prior: PositionPrior) -> None:
        """A prior at this moment, used until a pose is confirmed, with a covariance that grows with the distance since. One whose
        covariance is finite is published as long as the map gives no pose: DEGRADED, by odometry from there. A person's takes the place of
        a confirmed pose that it contradicts, and stays until fixes contradict it with more evidence than it has."""
        if prior.is_revisable and self._confirmed is not None:
            if agrees(prior, self._confirmed, self._base_from_body):
                return
            self.forget_pose()
        self._prior = InitialPosePrior(prior, self._base_from_body)

    def forget_pose(self) -> None:
        """Searches in the whole map from the next frame on; a map query that goes on is given up."""
        self._confirmed = self._prior = self._work = self._query_frame = None
        self._candidates.reset()
        self._was_tracking, self._failed_queries = False, 0
        self._failed_places.clear()
        self.perception.give_up()

    def handle_version(
        self,
        version: int,
        tiles: Iterable[Tile],
        vocabulary: Vocabulary,
        survey_focal_px: float,
        lookalikes: LookAlikes | None = None,
    ) -> None:
        """The tiles to use from now on, all of one version. A map query that goes on is given up.

        lookalikes: what places that are not in the map have in common with it; None where nobody measured it.
        """
        self._lookalikes = lookalikes
        self._map_version = version
        view = MapView(tiles, vocabulary, survey_focal_px)
        self._relocalizer = Relocalizer(view, self._camera, self._settings.relocalizer)
        self._work = self._query_frame = None
        self._failed_places.clear()
        self.perception.give_up()

    def start(self) -> Start | None:
        """What another localizer, with the same odometry, goes on with; None while a map query goes on, as its fix would be missing."""
        if self._work is not None:
            return None
        prior = self._prior
        known = self._confirmed or (None if prior is None else prior.hypothesis)
        start = Start(was_tracking=self._was_tracking, failed_queries=self._failed_queries)
        if known is None:
            return start
        return replace(
            start,
            frame_index=known.frame_index,
            stamp_ns=known.stamp_ns,
            support=known.support,
            map_from_body=known.map_from_body,
            cov_rot_trans=known.cov_rot_trans,
            is_confirmed=self._confirmed is not None,
            is_revisable=prior is not None and prior.is_revisable,
            travelled_m=0.0 if prior is None else prior.travelled_m,
            has_broken=known.has_broken,
        )

    def begin(self, start: Start) -> None:
        """Goes on from `start` with the next frame."""
        self.forget_pose()
        self._was_tracking, self._failed_queries = start.was_tracking, start.failed_queries
        if start.map_from_body is None or start.cov_rot_trans is None:
            return
        at_frame = start.map_from_body, start.cov_rot_trans
        known = PoseHypothesis(start.frame_index, start.stamp_ns, *at_frame, *at_frame, support=start.support)
        known.has_broken = start.has_broken
        if start.is_confirmed:
            self._confirmed = known
        else:
            self._prior = InitialPosePrior.at(known, self._base_from_body, is_revisable=start.is_revisable)
            self._prior.travelled_m = start.travelled_m

    def handle_stereo(self, frame: RectifiedFrame) -> Estimate:
        """The estimate at `frame`, newer than any before."""
        begun_s = self._clock()
        frame, image = self.perception.judge(frame)
        judged_s = self._clock()
        odometry, image = self.perception.follow(frame, image)
        tracked_s = self._clock()
        if self._last_ns is not None and is_away(self._last_ns, odometry):
            given = self._prior  # one that came since the last frame says where the robot is now
            self.forget_pose()
            self._prior = given if given is not None and given.is_new else None
        # Tracks are lost though the picture is sound: something came before the cameras, or the robot is elsewhere.
        has_broken = odometry.status is OdometryStatus.DEGRADED and image.cause is Cause.NONE
        self._propagate(odometry, has_broken)
        is_reversed = self.perception.is_reversed(frame, is_localized=self._confirmed is not None)
        result = QueryResult(refused=REVERSED_TEXT) if is_reversed else self._query_map(frame, odometry, has_broken)
        self._last_ns = frame.stamp_ns
        stage_s = {
            "image_quality": judged_s - begun_s,
            "odometry": tracked_s - judged_s,
            "map": self._clock() - tracked_s,
        }
        estimate = Estimate(
            stamp_ns=odometry.stamp_ns,
            status=Status.INITIALISING,
            map_from_body=None,
            cov_rot_trans=None,
            map_version=self._map_version,
            hypotheses=(),
            odometry=odometry,
            stage_s=stage_s,
            cause=image.cause,
            image=image,
            **result._asdict(),
        )
        prior, has_failed = self._prior.hypothesis if self._prior else None, self._failed_queries > 0
        state = LocalizationState(self._confirmed, self._candidates, prior, has_failed, self._was_tracking)
        last_fix_ns = None if self._confirmed is None else self._confirmed.stamp_ns
        assembled = assemble(estimate, state, self._track)
        return self.perception.judged(assembled, last_fix_ns, was_localized=self._was_tracking)

    def _propagate(self, odometry: OdometryEstimate, has_broken: bool) -> None:
        """Propagates every hypothesis to the present frame."""
        change, last = odometry.new_odom_from_old_odom, self._last_odom_from_body
        if last is not None and change is not None:
            last = change @ last
        step = np.eye(4) if last is None else se3_inverse(last) @ odometry.odom_from_body
        if odometry.previous_from_body is not None:
            step = odometry.previous_from_body
        for hypothesis in [*self._hypotheses(), *([self._query_frame] if self._query_frame else [])]:
            hypothesis.propagate(self.perception, odometry, step, self._track)
            hypothesis.has_broken |= has_broken
            if change is not None:
                hypothesis.history.redefine_odom(change)
        if change is not None:
            self._candidates.redefine_odom(change)
            self._search_gate.redefine_odom(change)
        self._last_odom_from_body = odometry.odom_from_body
        if self._prior is not None:
            self._prior.propagate(self.perception, odometry, step, self._track)

    def _hypotheses(self) -> list[PoseHypothesis]:
        confirmed = [self._confirmed, *self._confirmed.kidnap_hypotheses] if self._confirmed else []
        return [*confirmed, *self._candidates.tracked(), *(self._prior.tracked() if self._prior else [])]

    def _query_map(self, frame: RectifiedFrame, odometry: OdometryEstimate, has_broken: bool) -> QueryResult:
        """The result of a map query that is finished with this frame, an empty one otherwise.

        Its stamp is that of the frame that it is for. Queries are spread over frames, but for the first one, those after a gap, and
        those of recordings with hardly more frames than queries. Where tracks broke one begins at once.
        """
        is_at_once, is_urgent = False, has_broken and not self._failed_queries
        if is_urgent and not self._is_urgent:
            self._work = self._query_frame = None  # a frame before the break says nothing about where the robot is now
        if self._work is None:
            is_due = is_urgent or self._is_query_due(frame.stamp_ns, odometry)
            if self._relocalizer is None or not self.perception.may_query(is_due=is_due):
                return QueryResult()
            is_at_once = self._is_sparse(frame.stamp_ns) or odometry.after_gap
            self._query_ns = frame.stamp_ns
            self._query_frame = PoseHypothesis.at(odometry, np.eye(4), np.zeros((6, 6)))
            self._query_input, self._query_features = (frame, odometry), None
            for hypothesis in self._hypotheses():
                hypothesis.mark_query()
            is_at_rest = self._confirmed is None and not self._search_gate.is_new(odometry.odom_from_body)
            self._is_urgent, self._slices = is_urgent, _MORE_SLICES if is_at_rest or is_urgent else 1
            if not is_at_rest:
                self._failed_places.clear()
            self._work = self._query(frame, self._relocalizer)
        assert self._query_frame is not None
        try:
            for _ in range(self._slices):
                next(self._work)
            while is_at_once:
                next(self._work)
        except StopIteration as done:
            result: QueryResult = done.value._replace(fix_stamp_ns=self._query_frame.stamp_ns)
            self._work, self._query_frame, self._is_urgent = None, None, False
            if self._relocalizer is not None and self._query_input is not None and self._query_features is not None:
                is_confirmed = self._confirmed is not None
                looked = FinishedQuery(
                    *self._query_input, self._query_features, result.fix, self._relocalizer, is_confirmed
                )
                self.perception.add(looked)
            self._failed_queries = 0 if result.fix is not None else self._failed_queries + 1
            return result
        return QueryResult()

    def _is_query_due(self, stamp_ns: int, odometry: OdometryEstimate) -> bool:
        support = 0 if self._confirmed is None else self._confirmed.support
        is_sure = odometry.inertial and not self._failed_queries
        interval_s, last_ns = self._track.query_interval_s(support, is_sure=is_sure), self._query_ns
        return last_ns is None or odometry.after_gap or (stamp_ns - last_ns) * 1e-9 >= 0.999 * interval_s

    def _is_sparse(self, stamp_ns: int) -> bool:
        """Whether there are too few frames to spread a query over."""
        if self._query_ns is None or self._last_ns is None:
            return True
        return (stamp_ns - self._last_ns) * 1e-9 > _SPREAD_SHARE * self._track.fix_interval_s

    def _query(self, frame: RectifiedFrame, relocalizer: Relocalizer) -> TimeSliced[QueryResult]:
        features = self._query_features = yield from self.perception.extract(relocalizer, frame)
        if self._confirmed is None:
            fixes = yield from self._search(features, relocalizer)
            return (yield from self._update_candidates(fixes))
        map_from_body, covariance = self._confirmed.query_map_from_body, self._confirmed.query_cov
        near = self._near(features, relocalizer, self._confirmed)
        fixes = [] if near is None else [near]
        is_sparse = self._is_sparse(frame.stamp_ns)
        if near is None and (is_sparse or self._failed_queries + 1 >= self._track.search_after_failed):
            yield
            fixes = yield from relocalizer.anywhere(features, None, (map_from_body @ self._body_from_cam)[:3, :3])
            fixes = [fix for fix in fixes if fix.inliers >= self._settings.fix.min_inliers]
        if not fixes:
            return QueryResult(None, "nothing in the map agrees with this frame")
        return self._update_confirmed(fixes, map_from_body, covariance, is_near=near is not None)

    def _near(self, features: FrameFeatures, relocalizer: Relocalizer, hypothesis: PoseHypothesis) -> Fix | None:
        """The fix near a hypothesis at the frame of the query."""
        map_from_body = hypothesis.query_map_from_body
        map_from_cam = map_from_body @ self._body_from_cam
        cov_cam = transport_cov(hypothesis.query_cov, map_from_cam[:3, 3] - map_from_body[:3, 3])
        return relocalizer.near(features, map_from_cam, cov_cam)

    def _search(self, features: FrameFeatures, relocalizer: Relocalizer) -> TimeSliced[list[Fix]]:
        """Fixes in the whole map, or within the prior; around the candidates first."""
        fixes: list[Fix] = []
        candidates = self._candidates.hypotheses
        for number, candidate in enumerate(candidates):
            fix = self._near(features, relocalizer, candidate)
            if fix is not None:
                fixes.append(fix)
            if number % _HYPOTHESES_AT_ONCE == _HYPOTHESES_AT_ONCE - 1:
                yield
        rotation = None
        if len(candidates) == 1:
            rotation = (candidates[0].query_map_from_body @ self._body_from_cam)[:3, :3]
        near = None if self._prior is None else self._prior.is_near(relocalizer.view.map_from_cam[:, :3, 3])
        fixes = yield from relocalizer.anywhere(features, near, rotation, fixes, self._failed_places)
        fixes = [fix for fix in fixes if self._is_reliable(fix)]
        if self._prior is None:
            return fixes
        prior = self._prior
        within = [fix for fix, hypothesis in self._observations(fixes) if prior.is_compatible(hypothesis)]
        if within or not prior.is_revisable:
            return fixes if prior.is_revisable else within  # a person may have named an alias of the place
        yield
        fixes = yield from relocalizer.anywhere(features, None, None)
        fixes = [fix for fix in fixes if self._is_reliable(fix)]
        if not prior.is_contradicted(self._observations(fixes), self._track, self._lookalikes):
            return []
        self._prior = None
        self._candidates.reset()  # what they name must be confirmed as without a prior
        return fixes

    def _is_reliable(self, fix: Fix) -> bool:
        return is_reliable(fix, self._settings.fix, self._track.strong_inliers)

    def _observations(self, fixes: Sequence[Fix]) -> Observations:
        """The fixes of the query that goes on, with their poses at the present."""
        assert self._query_frame is not None
        found = [(fix, PoseHypothesis.at_query(self._query_frame, *self._at_body(fix))) for fix in fixes]
        return found if self._prior is None else self._prior.weighed(found, self._track)

    def _odom_from_body(self) -> Array:
        assert self._last_odom_from_body is not None
        return self._last_odom_from_body

    def _at_body(self, fix: Fix) -> tuple[Array, Array]:
        """A fix as map_from_body with its covariance (map axes, about the body)."""
        map_from_body = fix.map_from_cam @ self._cam_from_body
        return map_from_body, transport_cov(fix.cov_rot_trans, map_from_body[:3, 3] - fix.map_from_cam[:3, 3])

    def _update_confirmed(
        self, fixes: list[Fix], map_from_body: Array, covariance: Array, *, is_near: bool
    ) -> QueryResult:
        """Kalman update of the confirmed pose at the frame of the query. Fixes beyond its chi-square gate are refused, and so are
        several within it: long without the map, the gate may hold the pose's own alias.

        Sources: Bar-Shalom et al. 2001 (validation gate), Bucy and Joseph 1968 (covariance update).
        """
        assert self._confirmed is not None
        assert self._query_frame is not None
        innovations = [(fix, *innovation_of(*self._at_body(fix), map_from_body, covariance)) for fix in fixes]
        # A fix near the prediction is tested by the gate alone; one found by search must be reliable besides.
        limit = self._track.innovation_limit
        gated = [entry for entry in innovations if entry[2] <= limit and (is_near or self._is_reliable(entry[0]))]
        fix, error, innovation = min(innovations, key=lambda entry: entry[2])
        off_m = float(np.linalg.norm(error[3:]))
        if len(gated) != 1:
            self._detect_kidnapping(fixes)
            if gated:
                return QueryResult(None, f"{len(gated)} places agree with what was seen", innovation)
            reason = f"the fix is {off_m:.2f} m off, more than its covariance admits"
            return QueryResult(None, reason, innovation, off_m if is_near else None)
        _, cov_fix = self._at_body(fix)
        support = self._confirmed.support + 1
        updated = kalman_update(map_from_body, covariance, error, cov_fix)
        self._confirmed = PoseHypothesis.at_query(self._query_frame, *updated)
        self._confirmed.support = support
        return QueryResult(fix, "", innovation, off_m)

    def _detect_kidnapping(self, fixes: list[Fix]) -> None:
        """Abandons the confirmed pose when refused fixes agree with each other query after query; theirs must be confirmed anew."""
        assert self._confirmed is not None
        hypotheses = self._confirmed.kidnap_hypotheses
        self._candidates.observe(self._observations(fixes), hypotheses, self._odom_from_body())
        hypotheses = self._confirmed.kidnap_hypotheses = recent(hypotheses, self._track)
        telling = [h.support for h in hypotheses if h.speaks_against_others(self._track)]
        if max(telling, default=0) >= self._track.kidnap_fixes:
            self._candidates.reset(self._confirmed, hypotheses)
            self._confirmed = None
            self._prior = None  # it led to that pose

    def _update_candidates(self, fixes: list[Fix]) -> TimeSliced[QueryResult]:
        """Updates the candidates, and confirms the one without competitors that has enough support or a tight prior."""
        candidates = self._candidates
        is_near = self._prior is not None and self._prior.is_tight(self._track.near_prior_sigma_m)
        # Whether the robot cannot be where nothing is mapped and all looks like a place of the map.
        is_excluded = self._lookalikes is not None and (is_near or self._track.is_whole_site_mapped)
        candidates.lookalikes = LookAlikes(0.0, 0.0) if is_excluded else self._lookalikes
        yield from candidates.update(self._observations(fixes), self._odom_from_body())
        if not fixes:
            return QueryResult(None, "nothing in the map agrees with this frame")
        (best, *_), competitors = candidates.ranking()
        if competitors:
            return QueryResult(None, f"{len(competitors) + 1} places agree with what was seen")
        moved_m = None
        has_prior = self._prior is not None and self._prior.confirms(best, self._track)
        if not has_prior and candidates.may_be_lookalike(best):
            return QueryResult(None, "a place that is not in the map may look as much like this one")
        if has_prior or candidates.is_confirmed(best, fixes):
            moved_m = candidates.moved_m(best)
            candidates.reset()
            self._confirmed, self._prior = best, None
            self._was_tracking = True
        best_m = best.now_map_from_body[:3, 3]
        for fix, hypothesis in self._observations(fixes):
            if np.linalg.norm(hypothesis.now_map_from_body[:3, 3] - best_m) < _OWN_FIX_M:
                return QueryResult(fix, moved_m=moved_m)
        return QueryResult(None, "the fix does not agree with those before", moved_m=moved_m)
