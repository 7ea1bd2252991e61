"""The localizer: samples and tiles in, one estimate for each frame out. Pure."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from fleetmap.mapformat.building import Floor
from fleetmap.mapformat.map_errors import UNKNOWN_ERRORS, MapErrors
from fleetmap.messages import Cause
from fleetmap.odometry.estimate import is_away
from fleetmap.relocalization.map_view import LookAlikes, MapView
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.sensors.rectification import MountedRig, RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, PositionPrior, WheelSample
from locclient.localization.calibration.monitor import CalibrationMonitor, with_calibration
from locclient.localization.estimate import Estimate, assemble
from locclient.localization.held_maps import HeldMap, HeldMaps
from locclient.localization.map_query import MapQuery
from locclient.localization.perception import Percept, Perception
from locclient.localization.pose_tracker import PoseTracker, QueryResult, Start
from locclient.localization.priors.given import GivenPrior
from locclient.localization.priors.lift_ride import LiftRide
from locclient.localization.protection import ProtectionMonitor
from locclient.localization.settings import LocalizerSettings


class Localizer:
    """Localizes one robot in one map version; a new version is adopted without losing the pose.

    `Perception` makes a `Percept` of a frame; `PoseTracker` propagates the pose; `priors` tell where the robot may be; the fixes of
    `MapQuery` correct it; `CalibrationMonitor` judges the cameras by them.
    """

    def __init__(self, rig: MountedRig, settings: LocalizerSettings, clock: Callable[[], float] = lambda: 0.0) -> None:
        """clock: seconds, measures the stages; the default measures nothing."""
        self._rig, self._settings, self._clock = rig, settings, clock
        self.perception = Perception(rig, settings, clock)
        self._calibration = CalibrationMonitor(rig, settings.relocalizer)
        self.maps = HeldMaps()
        self._tracker = PoseTracker(settings, rig.mounted, rig.base_from_body, self.maps)
        self._query = MapQuery(self._tracker, settings, len(rig.mounted))
        self._protection = ProtectionMonitor(self._tracker, settings.track)
        self._tracker.on_restart.append(self._calibration.give_up)
        self._given = GivenPrior(self._tracker)
        self._lift = LiftRide(self._tracker, self.perception.gauge)
        self._last_ns: int | None = None

    def handle_imu(self, samples: ImuSamples) -> None:
        self.perception.handle_imu(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        self.perception.handle_wheel(samples)
        self._calibration.watch.wheels.handle(samples)
        self._protection.has_wheels |= bool(samples)

    def handle_prior(self, prior: PositionPrior) -> None:
        """Use a prior from the next frame on until a pose is confirmed, with a covariance that grows with the distance since. One with
        finite covariance is published, DEGRADED and propagated by odometry, until the map gives a pose. An operator's replaces a confirmed
        pose that it contradicts, until fixes outweigh it."""
        self._given.waiting = prior

    def handle_contradiction(self, text: str) -> None:
        """Use no images from now on for this reason, by all other sensors, and drop the pose by them; empty: use them again."""
        if text and not self._calibration.contradiction:
            was_tracking = self._tracker.was_tracking
            self.forget_pose()
            self._tracker.was_tracking = was_tracking
        self._calibration.contradiction = text

    def forget_pose(self) -> None:
        """Search the whole map from the next frame on; cancel a running map query."""
        self._given.waiting = None
        self._tracker.forget()

    def handle_version(
        self,
        version: int,
        view: MapView,
        lookalikes: LookAlikes | None,
        alias_step_m: float,
        site: str = "",
        errors: MapErrors = UNKNOWN_ERRORS,
    ) -> None:
        """Use this part of a version from now on; cancel a running map query.

        lookalikes: similarity of unmapped places to the map; None if not measured. alias_step_m: smallest distance at which its
        places look alike. site: of another one's map in the building, see `handle_building`; empty for the robot's own. errors: of the
        version's own places.
        """
        settings, mounted = self._settings.relocalizer, self._rig.mounted
        relocalizers = tuple(Relocalizer(view, camera, settings, site) for camera, _ in mounted)
        self.maps.by_floor[site] = HeldMap(version, relocalizers, lookalikes, alias_step_m, errors)
        self._query.begin_anew()
        self._calibration.give_up()

    def handle_building(self, building: Mapping[str, Floor]) -> None:
        """Use the robot's building: its own site's part, which is called "", and others by their sites. Their maps follow by
        `handle_version`; those of sites that are no part of it any more are dropped. Without any, the robot has its own site alone. A robot
        whose place is in none of them any more, or not known after a ride in the building before, searches all of them."""
        self._lift.use(building)
        self.perception.gauges = bool(building)
        self.maps.use_building(building)
        self._query.begin_anew()
        self._tracker.keep_to(building.keys() | {""})

    def start(self) -> Start | None:
        """Return the state with which another localizer of the same odometry can start; None during a map query, whose fix is missing."""
        return None if self._query.job is not None else self._tracker.start(self._query.failed)

    def begin(self, start: Start) -> None:
        """Continue from `start` with the next frame."""
        self.forget_pose()
        self._tracker.begin(start)
        self._query.failed = start.failed_queries

    def handle_stereo(self, frame: RectifiedFrame) -> Estimate:
        """Return the estimate at `frame`, which must be newer than all before."""
        percept, frame = self.perception.perceive(frame, self._tracker.frame_indices)
        begun_s = self._clock()
        estimate = self.localize(percept, frame)
        estimate.stage_s.update(self.perception.stage_s | {"map": self._clock() - begun_s})
        return estimate

    def localize(self, percept: Percept, frame: RectifiedFrame | None = None) -> Estimate:
        """Return the estimate by a percept, newer than all before. frame: its images; None if `percept` has all data of the frame."""
        tracker, odometry = self._tracker, percept.odometry
        is_away_now = self._last_ns is not None and is_away(self._last_ns, odometry)
        if not self._lift.doubts() if odometry.is_lifted else is_away_now:
            tracker.forget(is_carried=odometry.is_lifted)
        self._last_ns = odometry.stamp_ns
        tracker.propagate(odometry, percept.motions, has_broken=percept.has_broken)
        for source in (self._given, self._lift):  # each tells what it has not told before
            if (prior := source.prior(percept)) is not None:
                tracker.take(prior)
        if frame is not None:
            self._calibration.work()
            percept.is_reversed = bool(self._calibration.contradiction) or (
                self.perception.view == 0
                and self._calibration.is_reversed(frame, is_localized=tracker.confirmed is not None)
            )
            percept.calibration = self._calibration.state
        result = self._query.step(percept, frame, is_riding=self._lift.is_riding)
        self._protection.handle(result)
        if frame is not None:
            finished = self._query.finished
            if finished is not None and finished.fix is not None:
                place = self.maps.with_error(tracker.place_by(finished.fix))
                self.perception.odometry.handle_fix(finished.odometry, *place[:2], is_confirmed=finished.is_confirmed)
            if self._query.finished is not None and self._query.view == 0:
                self._calibration.add(self._query.finished)
            percept.calibration = self._calibration.state
        return self._report(percept, result)

    def _report(self, percept: Percept, result: QueryResult) -> Estimate:
        tracker = self._tracker
        is_riding = self._lift.is_riding or (self._lift.is_inside and tracker.confirmed is None)
        cause = percept.image.cause or (Cause.CARRIED if tracker.is_carried else Cause.NONE)
        estimate = Estimate(
            stamp_ns=percept.odometry.stamp_ns,
            odometry=percept.odometry,
            map_version=self.maps.version_on(tracker.floor),
            cause=Cause.RIDING if is_riding else cause,
            image=percept.image,
            view_causes=percept.view_causes,
            view=self._query.view,
            floor=tracker.floor,
            calibration=percept.calibration,
            **result._asdict(),
        )
        estimate = assemble(estimate, tracker, has_failed=self._query.failed > 0)
        if estimate.floor != tracker.floor:
            estimate = replace(estimate, map_version=self.maps.version_on(estimate.floor))
        fixed_ns = None if tracker.confirmed is None or percept.is_reversed else tracker.confirmed.stamp_ns
        estimate = with_calibration(estimate, self._rig, fixed_ns, was_localized=tracker.was_tracking)
        return self._protection.judged(estimate)
