"""The localizer: samples and tiles in, one honest estimate for each frame out. Never touches a file, a socket or a clock."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.bow import Vocabulary
from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array, se3_inverse
from fleetmap.mapformat import Tile
from fleetmap.messages import Cause, Status
from fleetmap.odometry import Odometry, OdometryEstimate, OdometryStatus
from fleetmap.relocalization.frame_features import FrameFeatures
from fleetmap.relocalization.map_view import MapView
from fleetmap.relocalization.relocalizer import Fix, Relocalizer, TimeSliced
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import ImuSamples, PositionPrior, WheelSample
from locclient.localization.estimate import Estimate, Hypothesis
from locclient.localization.hypothesis_scoring import still_held
from locclient.localization.hypothesis_set import Heard, HypothesisSet
from locclient.localization.image_quality import GOOD_IMAGE, ImageQualityMonitor
from locclient.localization.initial_pose_prior import InitialPosePrior
from locclient.localization.pose_hypothesis import PoseHypothesis, applied, difference, moved
from locclient.localization.settings import LocalizerSettings

_SPREAD_SHARE = 0.45  # of the time between two looks: frames that come less often are not made to share one
_CANDIDATES_AT_ONCE = 3  # in one slice of a search
_OWN_FIX_M = 0.3  # from the place that it speaks for


@dataclass(frozen=True, slots=True)
class _Outcome:
    """What a look at the map came to."""

    fix: Fix | None = None
    refused: str = ""
    innovation: float | None = None
    innovation_m: float | None = None
    moved_m: float | None = None


class Localizer:
    """Localises one robot in one map version; a new version is taken over without losing the place."""

    def __init__(
        self, calibration: RigCalibration, camera: StereoCamera, body_from_cam: Array, imu_minus_cam_s: float, settings: LocalizerSettings,
        clock: Callable[[], float] = lambda: 0.0,
    ) -> None:  # fmt: skip
        """`clock` (seconds) measures the stages; the default measures nothing."""
        self._clock = clock
        self._stage_s: dict[str, float] = {}
        self._settings = settings
        self._camera, self._body_from_cam = camera, body_from_cam
        self._cam_from_body = se3_inverse(body_from_cam)
        self._base_from_body = calibration.base_from_body
        self._odometry = Odometry(
            calibration, camera, body_from_cam, imu_minus_cam_s, settings.odometry, settings.stereo
        )
        self._relocalizer: Relocalizer | None = None
        self._map_version: int | None = None
        self._prior: InitialPosePrior | None = None
        self._anchor: PoseHypothesis | None = None  # the confirmed place
        self._confirmation = HypothesisSet(settings.track)  # of a place, while there is none
        self._last_odom: Array | None = None
        self._last_ns: int | None = None
        self._begun_ns: int | None = None  # of the last look
        self._work: TimeSliced[_Outcome] | None = None  # the look that goes on
        self._moment: PoseHypothesis | None = None  # the frame of that look, as the identity
        self._failed_looks = 0
        self._image_monitor = ImageQualityMonitor(settings.sight)
        self._image = GOOD_IMAGE
        self._ever_tracked = False

    def handle_imu(self, samples: ImuSamples) -> None:
        """IMU samples newer than any before."""
        self._odometry.handle_imu(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        """Wheel odometry newer than any before."""
        self._odometry.handle_wheel(samples)

    def handle_prior(self, prior: PositionPrior) -> None:
        """A coarse place at this moment; used for the search until a fix has been confirmed, widened by some of the way since. One
        whose covariance is finite is a place of its own as long as the map knows none: DEGRADED, by odometry from there."""
        self._prior = InitialPosePrior(prior, self._base_from_body)

    def handle_version(
        self, version: int, tiles: Iterable[Tile], vocabulary: Vocabulary, survey_focal_px: float
    ) -> None:
        """The tiles around, of one version; takes the place of what was held. A look that goes on is given up."""
        self._map_version = version
        view = MapView(tiles, vocabulary, survey_focal_px)
        self._relocalizer = Relocalizer(view, self._camera, self._settings.relocalizer)
        self._work = self._moment = None

    def handle_stereo(self, frame: RectifiedFrame) -> Estimate:
        """The estimate at `frame`, newer than any before."""
        begun = self._clock()
        self._image = self._image_monitor.judge(frame)
        if self._image.cause is Cause.FROZEN:
            frame = self._image_monitor.without_frozen(frame)
        judged = self._clock()
        odometry = self._odometry.handle_stereo(frame)
        if self._image.cause is Cause.NONE:
            self._image = replace(self._image, cause=self._image_monitor.judge_depth(odometry.scene_depth_m))
        tracked = self._clock()
        self._follow(odometry)
        outcome, looked_ns = self._see_map(frame, odometry)
        self._last_ns = frame.stamp_ns
        self._stage_s = {"sight": judged - begun, "odometry": tracked - judged, "map": self._clock() - tracked}
        return self._estimate(odometry, outcome, looked_ns)

    # --- odometry in, drift out ------------------------------------------------------------------------------------------

    def _follow(self, odometry: OdometryEstimate) -> None:
        """Carries every anchor to the present frame and counts the way."""
        change = odometry.new_odom_from_old_odom
        last = None if self._last_odom is None else self._last_odom if change is None else change @ self._last_odom
        step = np.eye(4) if last is None else se3_inverse(last) @ odometry.odom_from_body
        for anchor in [*self._anchors(), *([self._moment] if self._moment else [])]:
            anchor.carry(self._odometry, odometry, step, self._settings.track)
            if change is not None:
                anchor.tally.carry(change)
        if change is not None:
            self._confirmation.carry(change)
        self._last_odom = odometry.odom_from_body
        if self._prior is not None:
            self._prior.follow(self._odometry, odometry, step, self._settings.track)

    def _anchors(self) -> list[PoseHypothesis]:
        known = [self._anchor, *self._anchor.strangers] if self._anchor else []
        told = self._told()
        return [*known, *self._confirmation.anchors(), *([told] if told else [])]

    def _told(self) -> PoseHypothesis | None:
        """The place of a prior that is known in all directions."""
        return self._prior.place if self._prior is not None else None

    def _is_due(self, stamp_ns: int, odometry: OdometryEstimate) -> bool:
        settings, last = self._settings.track, self._begun_ns
        settled = self._anchor is not None and self._anchor.support >= settings.settled_fixes and not self._failed_looks
        settled = settled and odometry.inertial
        interval_s = max(settings.fix_interval_s, settings.settled_interval_s) if settled else settings.fix_interval_s
        return last is None or odometry.after_gap or (stamp_ns - last) * 1e-9 >= 0.999 * interval_s

    # --- looking at the map ----------------------------------------------------------------------------------------------

    def _see_map(self, frame: RectifiedFrame, odometry: OdometryEstimate) -> tuple[_Outcome, int | None]:
        """What a look that is finished with this frame came to, and the stamp of the frame that it was for.

        The first look, and those of recordings with hardly more frames than looks, are finished with the frame that they are for.
        """
        if self._relocalizer is None:
            return _Outcome(), None
        if self._work is None:
            if not self._is_due(frame.stamp_ns, odometry):
                return _Outcome(), None
            at_once = self._is_sparse(frame.stamp_ns) or odometry.after_gap
            self._begun_ns = frame.stamp_ns
            self._moment = PoseHypothesis.at(odometry, np.eye(4), np.zeros((6, 6)))
            for anchor in self._anchors():
                anchor.mark()
            self._work = self._look(frame, self._relocalizer)
        else:
            at_once = False
        assert self._moment is not None
        try:
            next(self._work)
            while at_once:
                next(self._work)
        except StopIteration as done:
            looked_ns, self._work, self._moment = self._moment.stamp_ns, None, None
            outcome: _Outcome = done.value
            self._failed_looks = 0 if outcome.fix is not None else self._failed_looks + 1
            return outcome, looked_ns
        return _Outcome(), None

    def _is_sparse(self, stamp_ns: int) -> bool:
        """Whether there are too few frames to spread a look over."""
        if self._begun_ns is None or self._last_ns is None:
            return True
        return (stamp_ns - self._last_ns) * 1e-9 > _SPREAD_SHARE * self._settings.track.fix_interval_s

    def _look(self, frame: RectifiedFrame, relocalizer: Relocalizer) -> TimeSliced[_Outcome]:
        query = yield from relocalizer.extract(frame)
        if self._anchor is None:
            fixes = yield from self._search(query, relocalizer)
            return (yield from self._weigh(fixes))
        map_from_body, covariance = self._anchor.then_map_from_body, self._anchor.then_cov
        map_from_cam = map_from_body @ self._body_from_cam
        near = relocalizer.near(query, map_from_cam, self._at_camera(map_from_body, covariance))
        fixes = [] if near is None else [near]
        is_sparse = self._is_sparse(frame.stamp_ns)
        if near is None and (is_sparse or self._failed_looks + 1 >= self._settings.track.search_after_failed):
            yield
            fixes = yield from relocalizer.anywhere(query, None, map_from_cam[:3, :3])
            fixes = [fix for fix in fixes if fix.inliers >= self._settings.fix.min_inliers]
        if not fixes:
            return _Outcome(None, "nothing in the map agrees with this frame")
        return self._correct(fixes, map_from_body, covariance, is_near=near is not None)

    def _search(self, query: FrameFeatures, relocalizer: Relocalizer) -> TimeSliced[list[Fix]]:
        """Fixes anywhere, around the candidates first; inside the prior where there is one."""
        fixes: list[Fix] = []
        candidates = self._confirmation.places
        for number, candidate in enumerate(candidates):
            map_from_body, covariance = candidate.then_map_from_body, candidate.then_cov
            fix = relocalizer.near(
                query, map_from_body @ self._body_from_cam, self._at_camera(map_from_body, covariance)
            )
            if fix is not None:
                fixes.append(fix)
            if number % _CANDIDATES_AT_ONCE == _CANDIDATES_AT_ONCE - 1:
                yield
        known = None
        if len(candidates) == 1:
            known = (candidates[0].then_map_from_body @ self._body_from_cam)[:3, :3]
        near = None if self._prior is None else self._prior.is_near(relocalizer.view.map_from_cam[:, :3, 3])
        fixes = yield from relocalizer.anywhere(query, near, known, fixes)
        return [f for f in fixes if self._counts(f) and self._in_prior(f)]

    def _counts(self, fix: Fix) -> bool:
        """Whether a fix may name a place: not by few landmarks where most of what stands there should have been seen and was not.
        Racks repeat: some landmarks of any agree with some of any other."""
        settings, strong = self._settings.fix, self._settings.track.strong_inliers
        return fix.inliers >= strong or (
            fix.inliers >= settings.min_inliers and fix.landmark_recall >= settings.min_hit_share
        )

    def _in_prior(self, fix: Fix) -> bool:
        if self._prior is None or self._moment is None:
            return True
        return self._prior.allows(PoseHypothesis.behind(self._moment, *self._at_body(fix)))

    # --- tracking --------------------------------------------------------------------------------------------------------

    def _correct(self, fixes: list[Fix], map_from_body: Array, covariance: Array, *, is_near: bool) -> _Outcome:
        """Kalman update of the confirmed place at the frame of the look; fixes outside its gate are refused, unless such fixes
        agree among themselves. So are several inside it: long without the map, the place may have grown to hold its own twin."""
        assert self._anchor is not None
        assert self._moment is not None
        judged = [(fix, *self._innovation(fix, map_from_body, covariance)) for fix in fixes]
        # What was looked for where the robot should be is judged by the prediction alone; what was found anywhere must count besides.
        limit = self._settings.track.innovation_limit
        inside = [entry for entry in judged if entry[2] <= limit and (is_near or self._counts(entry[0]))]
        fix, error, innovation = min(judged, key=lambda entry: entry[2])
        off_m = float(np.linalg.norm(error[3:]))
        if len(inside) != 1:
            self._consider_kidnapping(fixes)
            if inside:
                return _Outcome(None, f"{len(inside)} places agree with what was seen", innovation)
            said = f"the fix is {off_m:.2f} m off, more than its covariance admits"
            return _Outcome(None, said, innovation, off_m if is_near else None)
        _, measured_cov = self._at_body(fix)
        gain = np.linalg.solve(covariance + measured_cov, covariance).T
        rest = np.eye(6) - gain
        updated = rest @ covariance @ rest.T + gain @ measured_cov @ gain.T
        anchor = PoseHypothesis.behind(self._moment, applied(gain @ error, map_from_body), updated)
        anchor.support = self._anchor.support + 1
        self._anchor = anchor
        return _Outcome(fix, "", innovation, off_m)

    def _innovation(self, fix: Fix, map_from_body: Array, covariance: Array) -> tuple[Array, float]:
        """(6,) how far a fix is from what was predicted, and that squared by its covariance."""
        measured, measured_cov = self._at_body(fix)
        error = difference(measured, map_from_body)
        return error, float(error @ np.linalg.solve(covariance + measured_cov, error))

    def _consider_kidnapping(self, fixes: list[Fix]) -> None:
        """Refused fixes that agree with each other, frame after frame, end the belief in the old place; they must be confirmed anew."""
        assert self._anchor is not None
        settings, strangers = self._settings.track, self._anchor.strangers
        self._confirmation.hear(self._heard(fixes), strangers, self._odom())
        self._anchor.strangers = still_held(strangers, settings)
        if max(c.support for c in self._anchor.strangers) >= settings.kidnap_fixes:
            self._confirmation.reopen(self._anchor, self._anchor.strangers)
            self._anchor = None
            self._prior = None  # whatever named that place before is as wrong

    # --- confirmation ----------------------------------------------------------------------------------------------------

    def _weigh(self, fixes: list[Fix]) -> TimeSliced[_Outcome]:
        """Every fix speaks for a candidate or begins one; confirmed is the one that is left, or told from all others, with enough
        behind it, or with a tight prior."""
        known = self._confirmation
        yield from known.weigh(self._heard(fixes), self._odom())
        if not fixes:
            return _Outcome(None, "nothing in the map agrees with this frame")
        (best, *_), others = known.standing()
        if others:
            return _Outcome(None, f"{len(others) + 1} places agree with what was seen")
        moved_m = None
        is_told = self._prior is not None and self._prior.is_tight(self._settings.track.tight_prior_sigma_m)
        if is_told or known.is_confirmed(best, fixes):
            moved_m = known.moved_m(best)
            known.close()
            self._anchor, self._prior = best, None
            self._ever_tracked = True
        off_m = [
            np.linalg.norm(fresh.now_map_from_body[:3, 3] - best.now_map_from_body[:3, 3])
            for _, fresh in self._heard(fixes)
        ]
        own = [fix for fix, metres in zip(fixes, off_m, strict=True) if metres < _OWN_FIX_M]
        if not own:
            return _Outcome(None, "the fix does not agree with those before", moved_m=moved_m)
        return _Outcome(own[0], moved_m=moved_m)

    def _heard(self, fixes: Sequence[Fix]) -> Heard:
        """The fixes of the look that goes on, with their places at the present."""
        moment = self._moment
        assert moment is not None
        return [(fix, PoseHypothesis.behind(moment, *self._at_body(fix))) for fix in fixes]

    def _odom(self) -> Array:
        """The present odom_from_body."""
        assert self._last_odom is not None
        return self._last_odom

    # --- output ----------------------------------------------------------------------------------------------------------

    def _estimate(self, odometry: OdometryEstimate, outcome: _Outcome, looked_ns: int | None) -> Estimate:
        said = Estimate(
            odometry.stamp_ns, Status.INITIALISING, None, None, self._map_version, outcome.fix, outcome.refused,
            outcome.innovation, (), odometry, self._stage_s, self._image.cause, self._image, looked_ns,
            outcome.innovation_m, outcome.moved_m,
        )  # fmt: skip
        if self._anchor is not None:
            status, cause = self._worth(self._anchor, odometry)
            if status is not Status.TRACKING and self._anchor.strangers:  # there, or where fixes say since: who knows
                places = (self._anchor, *self._anchor.strangers)
                doubts = tuple(Hypothesis(c.now_map_from_body, c.support) for c in places)
                return replace(said, status=Status.AMBIGUOUS, cause=cause, hypotheses=doubts)
            now, covariance = self._anchor.now_map_from_body, self._published(self._anchor.now_cov)
            return replace(said, status=status, cause=cause, map_from_body=now, cov_rot_trans=covariance)
        likely, others = self._confirmation.standing()
        status = Status.AMBIGUOUS if others else Status.LOST if self._ever_tracked else Status.INITIALISING
        said = replace(
            said, status=status, hypotheses=tuple(Hypothesis(c.now_map_from_body, c.support) for c in likely)
        )
        if likely and not others:
            now, covariance = likely[0].now_map_from_body, self._published(likely[0].now_cov)
            return replace(said, map_from_body=now, cov_rot_trans=covariance)
        told = self._told()
        if likely or told is None or self._relocalizer is None:
            return said
        return self._as_told(said, told)

    def _as_told(self, said: Estimate, told: PoseHypothesis) -> Estimate:
        """Nothing in the map agrees: the prior and the way since, as far as that goes."""
        now, covariance = told.now_map_from_body, self._published(told.now_cov)
        radius_m = radius_95_m(told.now_cov)
        status = said.status if radius_m > self._settings.track.lost_radius_m else Status.DEGRADED
        cause = self._image.cause or Cause.UNMATCHED
        return replace(said, status=status, map_from_body=now, cov_rot_trans=covariance, cause=cause)

    def _worth(self, anchor: PoseHypothesis, odometry: OdometryEstimate) -> tuple[Status, Cause]:
        """Status of a confirmed place, and what is in the way of a better one."""
        settings = self._settings.track
        radius = radius_95_m(anchor.now_cov)
        age_s = (odometry.stamp_ns - anchor.stamp_ns) * 1e-9
        is_lost = odometry.status is OdometryStatus.DEGRADED
        cause = self._image.cause or (
            Cause.ODOMETRY if is_lost else Cause.UNMATCHED if self._failed_looks else Cause.NONE
        )
        if radius > settings.lost_radius_m:
            return Status.LOST, cause
        if (
            radius > settings.degraded_radius_m
            or age_s > settings.degraded_after_s
            or self._image.cause is Cause.FROZEN
        ):
            return Status.DEGRADED, cause
        return Status.TRACKING, Cause.NONE

    def _published(self, covariance: Array) -> Array:
        """With the map's own uncertainty, which is common to all fixes: no number of them averages it away."""
        settings = self._settings.track
        return covariance + np.diag([settings.map_sigma_rad**2] * 3 + [settings.map_sigma_m**2] * 3)

    def _at_body(self, fix: Fix) -> tuple[Array, Array]:
        """A fix as map_from_body with its covariance (map axes, about the body)."""
        map_from_body = fix.map_from_cam @ self._cam_from_body
        return map_from_body, moved(fix.cov_rot_trans, map_from_body[:3, 3] - fix.map_from_cam[:3, 3])

    def _at_camera(self, map_from_body: Array, covariance: Array) -> Array:
        return moved(covariance, (map_from_body @ self._body_from_cam)[:3, 3] - map_from_body[:3, 3])
