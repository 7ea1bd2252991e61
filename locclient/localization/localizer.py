"""The localizer: samples and tiles in, one estimate for each frame out. Pure."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fleetmap.bow import Vocabulary
from fleetmap.geometry import Array, se3_inverse
from fleetmap.mapformat import Tile
from fleetmap.mapformat.floors import Floor
from fleetmap.messages import Cause, Status
from fleetmap.odometry import OdometryEstimate, is_away, make_odometry
from fleetmap.relocalization.map_view import ALIAS_STEP_M, LookAlikes, MapView
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import MountedCamera, RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import ImuSamples, PositionPrior, WheelSample
from locclient.localization.calibration.monitor import CalibrationMonitor, with_calibration
from locclient.localization.calibration.watch import Mounting
from locclient.localization.estimate import Estimate, assemble
from locclient.localization.image_quality import UNUSABLE, ImageQuality, ImageQualityMonitor
from locclient.localization.lift_ride import (
    CARRIED_M,
    LIFT_SIGMAS,
    PLAN_SIGMA_M,
    SHORTEST_RIDE_S,
    LiftVisit,
    Ride,
    RideGauge,
    floors_after,
)
from locclient.localization.map_query import MapQuery
from locclient.localization.percept import Percept
from locclient.localization.pose_hypothesis import Motion, PoseHypothesis
from locclient.localization.pose_tracker import PoseTracker, Start
from locclient.localization.settings import LocalizerSettings

_DEAD_NS = 500_000_000  # without images, a view is dead


class _FloorMap(NamedTuple):
    """What `handle_version` tells of a floor's version."""

    version: int
    lookalikes: LookAlikes | None
    alias_step_m: float


class Localizer:
    """Localizes one robot in one map version; a new version is adopted without losing the pose.

    A frame passes image quality and odometry, which produce a `Percept`; `PoseTracker`, which propagates the pose;
    `MapQuery`, whose fixes correct it; and `CalibrationMonitor`.
    """

    def __init__(
        self,
        calibration: RigCalibration,
        camera: StereoCamera,
        body_from_cam: Array,
        imu_minus_cam_s: float,
        settings: LocalizerSettings,
        clock: Callable[[], float] = lambda: 0.0,
        others: Sequence[MountedCamera] = (),
    ) -> None:
        """clock: seconds, measures the stages; the default measures nothing. others: cameras of the rig's other views."""
        self._clock, self._settings = clock, settings
        self._mounted = (MountedCamera(camera, body_from_cam), *others)
        rig = (calibration, camera, body_from_cam, imu_minus_cam_s)
        self.odometry = make_odometry(*rig, settings.odometry, settings.stereo, others, by_wheels=True)
        self.percept: Percept | None = None  # of the last frame
        self._images = [ImageQualityMonitor(settings.image_quality) for _ in self._mounted]
        self._judged: tuple[RectifiedFrame, list[ImageQuality]] | None = None  # the last frame
        self._followed = 0  # view of the odometry
        self._last_frame: RectifiedFrame | None = None  # of a rig with several views
        self._mounting = Mounting(se3_inverse(body_from_cam), calibration.base_from_body)
        self._calibration = CalibrationMonitor(self._mounting, settings.relocalizer, imu_minus_cam_s)
        self._tracker = PoseTracker(settings, self._mounted, calibration.base_from_body)
        self._query = MapQuery(self._tracker, settings)
        self._maps: dict[str, _FloorMap] = {}
        self._floors: dict[str, Floor] = {}
        self._gauge = RideGauge(calibration.imu)
        self._body_from_base, self._imu_minus_cam_ns = (
            se3_inverse(calibration.base_from_body),
            int(imu_minus_cam_s * 1e9),
        )
        self._lift: LiftVisit | None = None
        self._last_ns: int | None = None

    def handle_imu(self, samples: ImuSamples) -> None:
        self.odometry.handle_imu(samples)
        if self._floors:
            self._gauge.handle_imu(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        self.odometry.handle_wheel(samples)
        if self._floors:
            self._gauge.handle_wheel(samples)
        self._calibration.watch.handle_wheel(samples)

    def handle_prior(self, prior: PositionPrior) -> None:
        """Use a prior at this moment until a pose is confirmed, with a covariance that grows with the distance since. A prior with finite
        covariance is published, DEGRADED and propagated by odometry, until the map gives a pose. An operator's prior replaces a confirmed
        pose that it contradicts, until fixes outweigh it."""
        if prior.floor and prior.floor not in self._floors.keys() | self._maps.keys():
            return  # a floor that the building had a moment ago
        if prior.is_revisable and self._tracker.confirmed is not None:
            if not self._tracker.is_contradicted_by(prior):
                return
            self.forget_pose()
        self._tracker.handle_prior(prior)

    def handle_contradiction(self, text: str) -> None:
        """Use no images from now on for this reason, by all other sensors, and drop the pose by them; empty: use them again."""
        if text and not self._calibration.contradiction:
            was_tracking = self._tracker.was_tracking
            self.forget_pose()
            self._tracker.was_tracking = was_tracking
        self._calibration.contradiction = text

    def forget_pose(self) -> None:
        """Search the whole map from the next frame on; cancel a running map query."""
        self._tracker.forget()
        self._query.forget()
        self._calibration.give_up()

    def handle_version(
        self,
        version: int,
        tiles: Iterable[Tile],
        vocabulary: Vocabulary,
        survey_focal_px: float,
        lookalikes: LookAlikes | None = None,
        alias_step_m: float = ALIAS_STEP_M,
        floor: str = "",
    ) -> None:
        """Use these tiles, all of one version, from now on; cancel a running map query.

        floor: site of another floor of the robot's building, one of those of `handle_floors`; empty for its own site.

        lookalikes: similarity of unmapped places to the map; None if not measured. alias_step_m: smallest distance at which its
        places look alike.
        """
        self._maps[floor] = _FloorMap(version, lookalikes, alias_step_m)
        self._compare_maps()
        view = MapView(tiles, vocabulary, survey_focal_px)
        relocalizers = (Relocalizer(view, camera, self._settings.relocalizer) for camera, _ in self._mounted)
        self._query.use(*relocalizers, floor=floor)
        self._calibration.give_up()

    def handle_floors(self, floors: Mapping[str, Floor]) -> None:
        """Use the floors of the robot's building: its own site's, which is called "", and others by their sites. Their maps follow by
        `handle_version`; those of floors that are none any more are dropped. Without any, the robot has its own site alone. A robot whose
        floor is none any more, or not known after a ride by the floors before, searches all of them."""
        self._floors, self._lift, self._query.is_riding = dict(floors), None, False
        self._query.use_floors({site: floor.frame.building_from_map for site, floor in floors.items()})
        self._maps = {floor: held for floor, held in self._maps.items() if not floor or floor in floors}
        self._compare_maps()
        known, prior = floors.keys() | {""}, self._tracker.prior
        if self._tracker.floor not in known or (
            prior is not None and (prior.is_ride or not prior.floors.keys() <= known)
        ):
            self.forget_pose()
        self._tracker.floor = self._tracker.floor if self._tracker.floor in known else ""

    def _compare_maps(self) -> None:
        """Take the look-alikes of all floors together: a fix may be on any of them."""
        known = [held.lookalikes for held in self._maps.values() if held.lookalikes is not None]
        self._tracker.lookalikes = None
        if known:
            shares = [each.max_wrong_share for each in known] + [1.0] * (len(self._maps) - len(known))
            most = max(each.recall for each in known), max(shares), max(each.inliers for each in known)
            self._tracker.lookalikes = LookAlikes(*most)
        self._tracker.alias_step_m = min((held.alias_step_m for held in self._maps.values()), default=ALIAS_STEP_M)

    @property
    def _is_in_lift(self) -> bool:
        return self._lift is not None and self._lift.is_inside

    def _cause(self, percept: Percept) -> Cause:
        if self._query.is_riding or (self._is_in_lift and self._tracker.confirmed is None):
            return Cause.RIDING
        return percept.image.cause or (Cause.CARRIED if self._tracker.is_carried else Cause.NONE)

    def _follow_lift(self, odometry: OdometryEstimate, ride: Ride) -> bool:
        """Return True while the robot rides, when no place may be confirmed. After a ride it may be on those floors of the lift to which
        the measured rise leads; on all of them if that is not known."""
        tracker, visit = self._tracker, self._lift
        prior = tracker.prior
        is_open = tracker.confirmed is None and prior is not None and prior.is_ride
        if tracker.confirmed is not None:
            places = [tracker.confirmed]
        else:
            places = [] if prior is None else prior.on_each_floor()
        lifts = frozenset[str]().union(*map(self._lifts_at, places))
        if not lifts:
            self._lift = visit._replace(is_inside=False) if is_open and visit is not None else None
            return self._follow_elsewhere(ride)
        # Until pictures have told the floor, the rises of all rides add up, also of a robot that has been outside between them.
        if visit is not None and (is_open or not (visit.is_ride or visit.lifts.isdisjoint(lifts))):
            visit = visit._replace(lifts=visit.lifts | lifts, is_inside=True)
        else:
            self._gauge.reset()  # it stands on a known floor, or came in without one
            ride = ride._replace(rise_m=0.0, sigma_m=ride.sigma_m if np.isinf(ride.sigma_m) else 0.0)
            visit = LiftVisit(lifts, places[0].floor, odometry.stamp_ns)
        stays_s = min(ride.rest_s, (odometry.stamp_ns - visit.since_ns) * 1e-9)
        floors = floors_after(self._floors, visit, ride)
        may_have_ridden = floors.keys() != {visit.floor} and (visit.is_doubted or stays_s >= SHORTEST_RIDE_S)
        if tracker.confirmed is None and prior is not None and prior.is_ride:
            if prior.floors.keys() != floors.keys():
                prior.floors = floors
                tracker.candidates.reset()
                self._query.forget()
        elif ride.is_moving or may_have_ridden:
            if tracker.confirmed is None:
                tracker.forget()
            else:
                tracker.ride(odometry, floors, PLAN_SIGMA_M)
            self._query.forget()
            self._calibration.give_up()
            visit = visit._replace(is_ride=True)
        self._lift = visit
        return ride.is_moving

    def _follow_elsewhere(self, ride: Ride) -> bool:
        """Follow a robot outside of every known lift, or without a place; return True while it must not find one."""
        tracker = self._tracker
        if tracker.prior is not None and tracker.prior.is_ride:
            if ride.is_moving:  # in a lift that is in no map
                tracker.forget()
            return ride.is_moving  # else it drives out
        if tracker.confirmed is None and ride.is_moving:
            tracker.candidates.reset()
            return True
        is_carried = ride.is_cut or abs(ride.rise_m) > max(CARRIED_M, LIFT_SIGMAS * ride.sigma_m)
        if is_carried:  # by a lift that is in no map, or a fork
            tracker.forget(is_carried=True)
            self._query.forget()
            self._calibration.give_up()
            self._gauge.reset()
        elif not ride.rest_s:
            self._gauge.reset()
        return False

    def _lifts_at(self, known: PoseHypothesis) -> frozenset[str]:
        """Return the lifts in which the robot may stand, by a pose's covariance."""
        floor = self._floors.get(known.floor)
        if floor is None or not floor.lifts or not np.isfinite(known.now_cov).all():
            return frozenset()
        reach_m = LIFT_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(known.now_cov[3:5, 3:5])[-1]))
        return floor.lifts_at((known.now_map_from_body @ self._body_from_base)[:2, 3], reach_m)

    def _version_on(self, floor: str) -> int | None:
        held = self._maps.get(floor)
        return None if held is None else held.version

    def start(self) -> Start | None:
        """Return the state with which another localizer of the same odometry can start; None during a map query, whose fix is missing."""
        return None if self._query.is_under_way else self._tracker.start(self._query.failed)

    def begin(self, start: Start) -> None:
        """Continue from `start` with the next frame."""
        self.forget_pose()
        self._tracker.begin(start)
        self._query.failed = start.failed_queries

    def awaits(self, frame: RectifiedFrame) -> bool:
        """Return True if a frame is to be left out: the followed view, alone usable, has images at a lower rate and none in this frame; or
        its last one is newer."""
        if self.percept is None or len(self._mounted) == 1:
            return False
        followed, since_ns = self._followed, frame.stamp_ns - self.percept.odometry.stamp_ns
        is_missing = followed > 0 and frame.others[followed - 1 : followed] in ((), (None,)) and since_ns < _DEAD_NS
        return since_ns <= 0 or (is_missing and all(image.cause in UNUSABLE for image in self._judge(frame)))

    def handle_stereo(self, frame: RectifiedFrame) -> Estimate:
        """Return the estimate at `frame`, which must be newer than all before."""
        begun_s = self._clock()
        images = self._judge(frame)
        self._choose_view([image.cause for image in images])
        number = self._followed
        image, followed = images[number], frame.view(number) or self._black(number, frame.stamp_ns)
        if image.cause is Cause.FROZEN:
            followed = self._images[number].without_frozen(followed)
        frame = frame if number else followed
        judged_s = self._clock()
        odometry = self.odometry.handle_stereo(followed)
        if image.cause is Cause.NONE:
            image = replace(image, cause=self._images[number].judge_depth(odometry.scene_depth_m))
        tracked_s = self._clock()
        causes = [image.cause if k == number else each.cause for k, each in enumerate(images)]
        self.percept = Percept(odometry, image, self._motions(), views=tuple(causes))
        if self._floors:
            if self.odometry.refuses_imu or self.odometry.accelerometer_fault:
                self._gauge.doubt()
            dt_s = 0.0 if self._last_ns is None else (odometry.stamp_ns - self._last_ns) * 1e-9
            self.percept.ride = self._gauge.advance(odometry.stamp_ns + self._imu_minus_cam_ns, dt_s)
        self._last_frame = frame if frame.others else None
        estimate = self.localize(self.percept, frame)
        estimate.stage_s.update(
            {"image_quality": judged_s - begun_s, "odometry": tracked_s - judged_s, "map": self._clock() - tracked_s}
        )
        return estimate

    def _judge(self, frame: RectifiedFrame) -> list[ImageQuality]:
        """Return the quality of the images of every view; each frame is judged once."""
        if self._judged is None or self._judged[0] is not frame:
            self._judged = frame, [self._quality(frame, number) for number in range(len(self._mounted))]
        return self._judged[1]

    def _quality(self, frame: RectifiedFrame, number: int) -> ImageQuality:
        """Return the quality of a view's images: of the first as rectified, of others as recorded, since few of them are rectified."""
        if number == 0:
            return self._images[0].judge(frame)
        other = frame.others[number - 1] if number <= len(frame.others) else None
        return ImageQuality(Cause.NO_FRAMES) if other is None else self._images[number].judge(other.recorded)

    def _black(self, number: int, stamp_ns: int) -> RectifiedFrame:
        """Return the frame of a view without images."""
        camera = self._mounted[number].camera
        return RectifiedFrame(stamp_ns, np.zeros((camera.height_px, camera.width_px), np.uint8), None, None)

    def _choose_view(self, causes: Sequence[Cause]) -> None:
        """Let the odometry follow another view that measures depth, or the first one, if the images of the present one are unusable."""
        present, last = self._followed, self.percept
        is_occluded = last is not None and last.image.cause is Cause.OCCLUDED
        if not (causes[present] in UNUSABLE or is_occluded):
            return
        for number, cause in enumerate(causes):
            may_lead = number == 0 or self._mounted[number].camera.baseline_m > 0
            if number != present and cause not in UNUSABLE and may_lead:
                before = None if self._last_frame is None else self._last_frame.view(number)
                self.odometry.follow(number, before)
                self._followed = number
                return

    def _motions(self) -> dict[int, Motion]:
        motions = {}
        for index in self._tracker.frame_indices:
            motion = self.odometry.motion_since(index)
            if motion is not None:
                motions[index] = Motion(*motion, self.odometry.will_forget(index))
        return motions

    def localize(self, percept: Percept, frame: RectifiedFrame | None = None) -> Estimate:
        """Return the estimate by a percept, newer than all before. frame: its images; None if `percept` has all data of the frame."""
        odometry, tracker = percept.odometry, self._tracker
        if (
            odometry.is_lifted and self._lift is not None and self._is_in_lift
        ):  # by the lift: the gauge knows how far, or nobody does
            self._lift = self._lift._replace(is_doubted=True)
        elif odometry.is_lifted or (self._last_ns is not None and is_away(self._last_ns, odometry)):
            tracker.forget(keeps_new_prior=True, is_carried=odometry.is_lifted)
            self._query.forget()
            self._calibration.give_up()
        self._last_ns = odometry.stamp_ns
        tracker.propagate(odometry, percept.motions, has_broken=percept.has_broken)
        if percept.ride is not None:
            self._query.is_riding = self._follow_lift(odometry, percept.ride)
        if frame is not None:
            self._calibration.work()
            percept.is_reversed = bool(self._calibration.contradiction) or (
                self._followed == 0 and self._calibration.is_reversed(frame, is_localized=tracker.confirmed is not None)
            )
            percept.calibration = self._calibration.state
        result = self._query.step(percept, frame)
        if frame is not None:
            if self._query.finished is not None and self._query.view == 0:
                self._calibration.add(self._query.finished)
            percept.calibration = self._calibration.state
        estimate = Estimate(
            stamp_ns=odometry.stamp_ns,
            status=Status.INITIALISING,
            map_from_body=None,
            cov_rot_trans=None,
            map_version=self._version_on(tracker.floor),
            hypotheses=(),
            odometry=odometry,
            stage_s={},
            cause=self._cause(percept),
            image=percept.image,
            views=percept.views,
            view=self._query.view,
            floor=tracker.floor,
            **result._asdict(),
        )
        estimate = assemble(
            estimate,
            self._settings.track,
            confirmed=tracker.confirmed,
            candidates=tracker.candidates,
            prior=None if tracker.prior is None else tracker.prior.hypothesis,
            has_failed=self._query.failed > 0,
            was_tracking=tracker.was_tracking,
            rides=() if tracker.prior is None or tracker.prior.names_floor else tracker.prior.on_each_floor(),
        )
        if estimate.floor != tracker.floor:
            estimate = replace(estimate, map_version=self._version_on(estimate.floor))
        fixed_ns = None if tracker.confirmed is None or percept.is_reversed else tracker.confirmed.stamp_ns
        return with_calibration(
            estimate, percept.calibration, self._mounting, fixed_ns, was_localized=tracker.was_tracking
        )
