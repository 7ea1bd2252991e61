"""Pose tracking in the map: a prior, competing candidates or one confirmed pose, propagated by the odometry. Pure."""

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array, length, se3_inverse
from fleetmap.inertial import GRAVITY_MPS2
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.relocalization.map_view import LookAlikes
from fleetmap.relocalization.relocalizer import EarlierFrame, Fix, FrameFeatures, is_reliable
from fleetmap.sensors.rectification import MountedCamera
from fleetmap.time_sliced import TimeSliced
from locclient.localization.alias_disambiguation import is_other_viewpoint
from locclient.localization.held_maps import UNKNOWN_COV, HeldMaps
from locclient.localization.hypothesis_set import HypothesisSet, Observations
from locclient.localization.place import ORIGIN, Place
from locclient.localization.pose_hypothesis import Motion, PoseHypothesis
from locclient.localization.priors.prior import Prior
from locclient.localization.settings import LocalizerSettings

_OWN_FIX_M = 0.3  # between a fix and the hypothesis that it supports
_EARLIER = 3  # frames that a query may pool with its own: of a metre of a drive
_OF_PRIOR = ("is_revisable", "is_told", "travelled_m")  # what a start keeps of it
_MISSED_STEPS = 1.5  # shortest steps between frames: a longer one missed some


class QueryResult(NamedTuple):
    """Result of a map query; fields as in Estimate."""

    fix: Fix | None = None
    refused: str = ""
    innovation: float | None = None
    innovation_m: float | None = None
    moved_m: float | None = None
    fix_stamp_ns: int | None = None


NO_AGREEMENT = QueryResult(refused="nothing in the map matches this frame")
ONE_OF_FLOORS = "another floor may look the same from here: drive a metre, pass a dock, or send a pose with its floor"
OUTSIDE_PRIOR = QueryResult(refused="what the map matches lies outside the given initial pose")


@dataclass(frozen=True, slots=True)
class Start:
    """Start state of a localizer; by default it searches the whole map.

    map_from_body (4, 4), cov_rot_trans (6, 6): the `Place` at frame `frame_index` of the odometry, None without one.
    is_confirmed: by fixes, with their stamp_ns and support; else by a prior, with its is_revisable, is_told and travelled_m, the distance
    since its arrival. has_broken: tracks were lost since. was_tracking: the robot knew its pose before; is_carried: it was lifted since.
    failed_queries: number of failed map queries in a row. floor: whose map the pose is in, empty for the robot's own site.
    """

    frame_index: int = 0
    stamp_ns: int = 0
    support: int = 0
    map_from_body: Array | None = None
    cov_rot_trans: Array | None = None
    is_confirmed: bool = False
    is_revisable: bool = False
    is_told: bool = True
    travelled_m: float = 0.0
    has_broken: bool = False
    was_tracking: bool = False
    is_carried: bool = False
    failed_queries: int = 0
    floor: str = ""


class _Unmatched(NamedTuple):
    """The frame of a query without a fix, as the identity; features of one of its cameras, body_from_cam (4, 4)."""

    frame: PoseHypothesis
    features: FrameFeatures
    view: int
    body_from_cam: Array


class PoseTracker:
    """Propagates hypotheses from frame to frame, confirms one of them, and gives it up.

    SEARCHING   no pose, or a DEGRADED one by a prior and odometry                    <--+
        | fixes                                                                          | forget
        v                                                                                |
    CANDIDATES  poses of fixes; AMBIGUOUS if several match the image                  ---+
        | enough fixes over enough distance or a tight prior, and no competitor       |  |
        v                                                                             |  |
    CONFIRMED   each fix within its gate updates it                                   ---+
        | several fixes beyond its gate agree with each other: the robot was carried
        v
    CANDIDATES  at the places of these fixes

    CONFIRMED   --its radius includes the next similar place-->  SEARCHING, with the pose as a prior
    """

    def __init__(
        self, settings: LocalizerSettings, mounted: Sequence[MountedCamera], base_from_body: Array, maps: HeldMaps
    ) -> None:
        """mounted: the cameras of the rig."""
        self._settings, self.settings = settings, settings.track
        self._mounted, self.base_from_body, self.maps = mounted, base_from_body, maps
        # Called when what was seen before says nothing of the robot's place any more.
        self.on_restart: list[Callable[[], None]] = []
        self._view, self.body_from_cam = 0, mounted[0].body_from_cam  # of the last query
        self.prior: Prior | None = None
        self.candidates = HypothesisSet(settings.track)
        self._repeated = HypothesisSet(settings.track)  # by all fixes of searches, also those of few matches
        self.confirmed: PoseHypothesis | None = None
        self.confirmed_by: Prior | None = None  # that it took, beside fixes
        self.was_tracking = False
        self.is_carried = False  # it was lifted since it knew its pose
        self.odom_from_body: Array | None = None  # of the last frame
        self.step_m = 0.0  # to the last frame
        self._last_ns, self._period_ns = 0, 1 << 62  # of frames: the last stamp, and the shortest step
        self._imu_ns: int | None = None  # stamp of the last frame with an IMU, None once its loss is a doubt
        self._query_frame: PoseHypothesis | None = None  # of the running map query, as the identity
        self._query_index: int | None = None  # of the last map query's frame
        # Of the last map query, and that from which another part follows the motion: propagated like the pose, of no effect on it.
        self.asked: PoseHypothesis | None = None
        self.followed: PoseHypothesis | None = None
        self.floor = ""  # of the last confirmed pose
        self._unmatched: list[_Unmatched] = []  # frames of queries since the last fix

    # --- priors and starts --------------------------------------------------------------------------------------------

    def prior_at(self, known: PoseHypothesis, **how: Any) -> Prior:
        """Return a pose at a frame of the odometry as a prior. how: arguments of `Prior`."""
        base = known.start.of_point(se3_inverse(self.base_from_body))
        since = PoseHypothesis(known.frame_index, known.stamp_ns, ORIGIN, ORIGIN)
        return Prior(base, since, known, self.base_from_body, self.settings, **how)

    def take(self, prior: Prior) -> None:
        """Use a prior from now on; it replaces any earlier one. One of a ride replaces the confirmed pose, too."""
        self.prior = prior
        if prior.is_ride:
            self.confirmed = None
            self.forget_frames()
            self.candidates.reset()
            self._restart()

    def move_prior(self, floors: Mapping[str, Array | None]) -> None:
        """Move the prior in force to other floors, as of `Prior.floors`."""
        assert self.prior is not None
        self.prior.floors = floors
        self.candidates.reset()
        self._restart()

    def keep_to(self, floors: Set[str]) -> None:
        """Forget a place on others than these floors, or on which one of them is open after a ride."""
        prior, is_known = self.prior, self.floor in floors
        if not is_known or (prior is not None and (prior.is_ride or not prior.floors.keys() <= floors)):
            self.forget()
        self.floor = self.floor if is_known else ""

    def forget(self, *, is_carried: bool = False) -> None:
        """Drop the pose and search the whole map. is_carried: the robot knows that it is lifted, and is LOST if it had a pose."""
        self.confirmed = self.confirmed_by = self.prior = self._query_frame = None
        self.forget_frames()
        self.candidates.reset()
        self._repeated.reset()
        self.was_tracking &= is_carried
        self.is_carried = self.was_tracking
        self._restart()

    def _restart(self) -> None:
        for act in self.on_restart:
            act()

    def start(self, failed_queries: int) -> Start:
        """Return the state with which another tracker of the same odometry can start."""
        start = Start(was_tracking=self.was_tracking, is_carried=self.is_carried, failed_queries=failed_queries)
        known = self.confirmed or (None if self.prior is None else self.prior.hypothesis)
        if known is None:
            return start
        found = {name: getattr(known, name) for name in ("frame_index", "stamp_ns", "support", "has_broken")}
        how = {} if self.prior is None else {name: getattr(self.prior, name) for name in _OF_PRIOR}
        return replace(start, **known.start._asdict(), **found, **how, is_confirmed=self.confirmed is not None)

    def begin(self, start: Start) -> None:
        """Continue from `start` with the next frame."""
        self.forget()
        self.was_tracking, self.is_carried = start.was_tracking, start.is_carried
        if start.map_from_body is None or start.cov_rot_trans is None:
            return
        place = Place(start.map_from_body, start.cov_rot_trans, start.floor)
        known = PoseHypothesis(start.frame_index, start.stamp_ns, place, place, support=start.support)
        known.has_broken, self.floor = start.has_broken, start.floor
        if start.is_confirmed:
            self.confirmed = known
        else:
            self.prior = self.prior_at(known, **{name: getattr(start, name) for name in _OF_PRIOR})

    # --- propagation --------------------------------------------------------------------------------------------------

    @property
    def frame_indices(self) -> set[int]:
        """Return frames of the odometry whose motion to the next frame `propagate` needs."""
        # Includes the last query's frame: another version may find a fix there, and continue from it.
        last_query = set() if self._query_index is None else {self._query_index}
        return {hypothesis.frame_index for hypothesis in self._tracked()} | last_query

    def propagate(self, odometry: OdometryEstimate, motions: Mapping[int, Motion], *, has_broken: bool) -> None:
        """Propagate every hypothesis to the present frame. has_broken: tracks are lost in a good image."""
        change, last = odometry.new_odom_from_old_odom, self.odom_from_body
        if odometry.inertial and not odometry.is_bridged:
            self._imu_ns = odometry.stamp_ns
        unheld_s = 0.0 if self._imu_ns is None else (odometry.stamp_ns - self._imu_ns) * 1e-9
        # What friction allows a robot to do that images misread: about its weight accelerates it at most.
        lost_imu = 0.5 * GRAVITY_MPS2 * unheld_s**2 > self.settings.degraded_radius_m
        self._imu_ns = None if lost_imu else self._imu_ns
        step_ns, self._last_ns = odometry.stamp_ns - self._last_ns, odometry.stamp_ns
        self._period_ns = min(self._period_ns, step_ns)
        if last is not None and change is not None:
            last = change @ last
        before = dict(odometry.revised).get(odometry.frame_index - 1, last)
        step = odometry.previous_from_body
        if step is None:
            step = np.eye(4) if before is None else se3_inverse(before) @ odometry.odom_from_body
        for hypothesis in self._tracked():
            earlier = hypothesis.now
            hypothesis.propagate(motions, odometry, step, self.settings)
            if hypothesis is self.confirmed:
                self._keep_error(hypothesis, earlier)
            hypothesis.has_broken |= has_broken
            hypothesis.lost_imu |= lost_imu
            hypothesis.missed |= step_ns > _MISSED_STEPS * self._period_ns
            if change is not None:
                hypothesis.history.redefine_odom(change)
        if change is not None:
            self.candidates.redefine_odom(change)
        self.odom_from_body = odometry.odom_from_body
        self.step_m = length(step[:3, 3])
        if self.prior is not None:
            self.prior.travelled_m += self.step_m

    def _keep_error(self, confirmed: PoseHypothesis, earlier: Place) -> None:
        """Add to a pose that comes from an earlier place by how much the map is worse there than here, and than an unmeasured one."""
        here, kept = np.maximum(self.maps.map_cov(confirmed.now), UNKNOWN_COV), (confirmed.start, confirmed.now)
        more = np.maximum(self.maps.map_cov(earlier) - here, 0.0)
        confirmed.start, confirmed.now = (at._replace(cov_rot_trans=at.cov_rot_trans + more) for at in kept)

    def _tracked(self) -> list[PoseHypothesis]:
        found = self.candidates.tracked() + self._repeated.tracked()
        if self.prior is not None:
            found += self.prior.tracked()
        if self.confirmed is not None:
            found.append(self.confirmed)
        found.extend(each.frame for each in self._unmatched)
        if self.followed is not None:
            found.append(self.followed)
        if self._query_frame is not None and all(each.frame is not self._query_frame for each in self._unmatched):
            found.append(self._query_frame)  # kept while its search goes on, it must not move twice
        return found

    # --- fixes of a map query -----------------------------------------------------------------------------------------

    def begin_query(self, odometry: OdometryEstimate, view: int = 0, now_from_then: Array | None = None) -> None:
        """Begin a map query with the present frame of a view; its fixes may follow some frames later.

        now_from_then (4, 4): the body's motion from the moment of that view's images to that of `odometry`; None if they are the same.
        """
        self._view, body_from_cam = view, self._mounted[view].body_from_cam
        self.body_from_cam = body_from_cam if now_from_then is None else now_from_then @ body_from_cam
        self._doubt_confirmed(odometry)
        for hypothesis in self._tracked():
            hypothesis.then = hypothesis.now
        self._query_frame = self.asked = PoseHypothesis.at(odometry)
        self._query_index = odometry.frame_index

    def _doubt_confirmed(self, odometry: OdometryEstimate) -> None:
        """Turn a pose whose radius exceeds half of the site's smallest repetition into a prior: a fix of the next bay or aisle would be
        within the gate of its covariance, and must be confirmed like any other."""
        confirmed, limit_m = self.confirmed, 0.5 * self.maps.alias_step_m
        if confirmed is None or not radius_95_m(self.maps.with_error(confirmed.now).cov_rot_trans) > limit_m:
            return
        self.candidates.reset()
        self.candidates.abandoned, self.confirmed, self.prior, self.followed = confirmed, None, None, None
        if confirmed.now.is_finite:
            self.prior = self.prior_at(PoseHypothesis.at(odometry, confirmed.now), is_revisable=True)

    def end_query(self) -> None:
        self._query_frame = None

    def keep_frame(self, features: FrameFeatures) -> None:
        """Keep the frame of the running query, which found no fix near the confirmed pose, for later ones; not the same view again, whose
        wrong matches would be the same."""
        assert self._query_frame is not None
        if all(self._is_aside(each) for each in self._unmatched):
            kept = _Unmatched(self._query_frame, features, self._view, self.body_from_cam)
            self._unmatched = [*self._unmatched, kept][-_EARLIER:]

    def forget_frames(self) -> None:
        """Drop all kept frames: each counts for one fix."""
        self._unmatched.clear()

    def earlier_frames(self) -> list[EarlierFrame]:
        """Return the kept frames of other viewpoints or cameras than those of the running query, if their pinholes are alike; of another
        baseline by their bearings alone."""
        found, lens = [], self._mounted[self._view].camera
        for each in self._unmatched:
            own = self._mounted[each.view].camera
            if self._is_aside(each) and replace(own, baseline_m=lens.baseline_m) == lens:
                earlier_from_query, covariance, _ = each.frame.then
                cam_from_query = se3_inverse(each.body_from_cam) @ earlier_from_query @ self.body_from_cam
                features = each.features if own == lens else each.features.without_depth()
                found.append(EarlierFrame(features, cam_from_query, covariance))
        return found

    def _is_aside(self, earlier: _Unmatched) -> bool:
        return earlier.view != self._view or is_other_viewpoint(earlier.frame.then.map_from_body)

    def observations(self, fixes: Sequence[Fix]) -> Observations:
        """Return the fixes of the running query with their poses at present."""
        query = self._query_frame
        assert query is not None
        places = [self.maps.with_error(self.place_by(fix)) for fix in fixes]
        found = [(fix, PoseHypothesis.at_query(query, place)) for fix, place in zip(fixes, places, strict=True)]
        return found if self.prior is None else self.prior.weighed(found)

    def is_reliable(self, fix: Fix) -> bool:
        return is_reliable(fix, self._settings.fix, self.settings.strong_inliers)

    def believed(self, fixes: Sequence[Fix]) -> list[Fix]:
        """Return the fixes that speak for a place, and those of few matches at the only place that searches agree on: chance matches do not
        repeat there while the noise of the images changes. An unmapped place that looks the same does, so they confirm no pose."""
        self._repeated.observe(self.observations(fixes), None)
        order, competitors = self._repeated.ranking()
        is_agreed = bool(order) and not competitors and order[0].support >= self.settings.confirming_fixes
        return [
            fix
            for fix, at in self.observations(fixes)
            if self._speaks(fix, at) or (is_agreed and order[0].is_same_pose(at, self.settings))
        ]

    def _speaks(self, fix: Fix, at: PoseHypothesis) -> bool:
        """Return True for a reliable fix, or one within the gate of a prior that names one place, such as a dock's: as near a confirmed
        pose, other places are excluded there, and few matches decide only about the last decimetres."""
        known = None if self.prior is None else self.prior.known_pose(0.5 * self.maps.alias_step_m)
        if self.is_reliable(fix):
            return True
        if known is None or fix.inliers < self._settings.fix.min_inliers or not at.now.shares_map(known.now):
            return False
        _, innovation = known.now.innovation_of(at.now)
        return innovation <= self.settings.innovation_limit

    def place_by(self, fix: Fix) -> Place:
        """Return the place of the body by a fix of the last query, without the map's own error."""
        return Place(fix.map_from_cam, fix.cov_rot_trans, fix.floor).of_point(se3_inverse(self.body_from_cam))

    def drops_prior(self, fixes: Sequence[Fix]) -> bool:
        """Return True if fixes, none within the prior, contradict it by now; then drop it: their places must be confirmed."""
        assert self.prior is not None
        if not self.prior.is_contradicted(self.observations(fixes), self.maps.lookalikes):
            return False
        self.prior = None
        self.candidates.reset()
        return True

    def update(self, fixes: list[Fix], confirmed: PoseHypothesis, *, is_near: bool) -> QueryResult:
        """Update the confirmed pose at the frame of the query (Kalman). Fixes beyond its chi-square gate are refused, and so are
        several within it: long without a fix, the gate may include an alias of the pose. The gate admits another error of the map than
        at the fixes before; the update does not weigh by it, so that the pose stays beside what the robot sees.

        Source: Bar-Shalom et al. 2001 (validation gate).
        """
        assert self._query_frame is not None
        if not fixes:
            return NO_AGREEMENT
        places = [self.maps.with_error(self.place_by(fix), confirmed.start) for fix in fixes]
        innovations = [(fix, *confirmed.then.innovation_of(place)) for fix, place in zip(fixes, places, strict=True)]
        # A fix near the prediction is tested by the gate alone; one found by search must also be reliable.
        limit = self.settings.innovation_limit
        gated = [entry for entry in innovations if entry[2] <= limit and (is_near or self.is_reliable(entry[0]))]
        fix, error, innovation = min(innovations, key=lambda entry: entry[2])
        off_m = float(np.linalg.norm(error[3:]))
        if len(gated) != 1:
            self._detect_kidnapping(fixes, confirmed)
            if gated:
                return QueryResult(None, f"{len(gated)} places match the image", innovation)
            reason = f"the fix is {off_m:.2f} m off, more than its covariance admits"
            return QueryResult(None, reason, innovation, off_m if is_near else None)
        self.confirmed = PoseHypothesis.at_query(self._query_frame, confirmed.then.updated(self.place_by(fix)))
        self.confirmed.support = confirmed.support + 1
        self._keep_error(self.confirmed, self.confirmed.start)
        self.candidates.reset()
        return QueryResult(fix, "", innovation, off_m)

    def _detect_kidnapping(self, fixes: list[Fix], confirmed: PoseHypothesis) -> None:
        """Abandon the confirmed pose when refused fixes agree with each other over several queries; confirm theirs anew."""
        assert self.odom_from_body is not None
        self.candidates.observe(self.observations(fixes), self.odom_from_body)
        telling = [h.support for h in self.candidates.hypotheses if h.speaks_against_others(self.settings)]
        if max(telling, default=0) >= self.settings.kidnap_fixes:
            self.candidates.abandoned = confirmed
            self.confirmed = None
            self.prior = None  # it led to that pose

    def update_candidates(self, fixes: list[Fix], *, outside: bool, is_one_map: bool = True) -> TimeSliced[QueryResult]:
        """Update the candidates, and confirm one without competitors and with enough support or a tight prior.

        outside: True if fixes outside the prior were left out. is_one_map: one alone was searched.
        """
        assert self.odom_from_body is not None
        candidates = self.candidates
        is_near = self.prior is not None and self.prior.is_tight(self.settings.near_prior_sigma_m)
        # True if the robot cannot be at an unmapped place that looks like a mapped one.
        lookalikes = self.maps.lookalikes
        is_excluded = lookalikes is not None and (is_near or self.settings.is_whole_site_mapped)
        candidates.lookalikes = LookAlikes(0.0, 0.0) if is_excluded else lookalikes
        observations = self.observations(fixes)
        for fix, at in observations:
            at.support = int(self._speaks(fix, at))
        yield from candidates.update(observations, self.odom_from_body)
        if not fixes:
            return OUTSIDE_PRIOR if outside else NO_AGREEMENT
        (best, *_), competitors = candidates.ranking()
        if competitors:
            told = "; ".join(hypothesis.evidence for hypothesis in (best, *competitors[:2]))
            return QueryResult(None, f"{len(competitors) + 1} places match the image: {told}")
        moved_m = None
        has_prior = self.prior is not None and best.support > 0 and self.prior.confirms(best)
        if not has_prior and (missing := self.maps.missing):
            return QueryResult(None, f"floor {min(missing)}, whose map is not here yet, may look the same")
        if not has_prior and candidates.may_be_lookalike(best):
            assert lookalikes is not None
            told = f"{best.evidence} here, {lookalikes.recall:.0%} there"
            return QueryResult(None, f"a place that is not in the map may look the same: {told}")
        is_telling = not candidates.has_low_recall(best)
        if has_prior or (is_telling and candidates.is_confirmed(best, fixes, is_one_map=is_one_map)):
            moved_m = candidates.moved_m(best)
            candidates.reset()
            self._repeated.reset()
            self.confirmed, self.floor = best, best.now.floor
            self.confirmed_by, self.prior = self.prior if has_prior else None, None
            self.was_tracking, self.is_carried = True, False
        for fix, hypothesis in self.observations(fixes):
            off_m = np.linalg.norm(hypothesis.now.position_m - best.now.position_m)
            if off_m < _OWN_FIX_M and hypothesis.now.shares_map(best.now):
                waits = self.confirmed is None and not is_one_map
                return QueryResult(fix, ONE_OF_FLOORS if waits else "", moved_m=moved_m)
        return QueryResult(None, "the fix does not agree with those before", moved_m=moved_m)
