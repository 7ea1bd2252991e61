"""One robot, frame by frame: localization, detection of failures, trials of new map versions. Pure."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array
from fleetmap.mapformat.building import BuildingFrame, Floor
from fleetmap.mapformat.manifest import building_frame
from fleetmap.messages import Cause, FailureKind, Flag, PoseMessage, Status
from fleetmap.odometry.mono.mono_modes import WheelOdometry
from fleetmap.recordings.images import StoredFrame, decode_frame
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import PositionPrior, WheelSample
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.localization.estimate import Estimate
from locclient.localization.localizer import Localizer
from locclient.localization.settings import LocalizerSettings
from locclient.maps.loaded_map import LoadedMap, tiles_within
from locclient.robot import motion_checks
from locclient.robot.continuous_odom import ContinuousOdom, PublishedPose
from locclient.robot.failure_monitor import Failure, FailureMonitor
from locclient.robot.failure_onset import Evidence, Onset, OnsetRecorder, refined_cause
from locclient.robot.failure_ring import FailureCut, FailureRing
from locclient.robot.version_trial import TrialSettings, VersionTrials

Clock = Callable[[], float]  # seconds
_MAY_BE_OVERLOAD = {Cause.NONE, Cause.ODOMETRY, Cause.UNMATCHED}  # what frames too far apart look like


class FailureContext(NamedTuple):
    """A failure with the data of its report: its onset, the evidence for its cause, and the running version.

    unmatched: onset of the search for the pose during which it occurred, when the pose was last known; else that of the failure.
    cut: recording of the seconds around its onset, None without one. flags: of sensors left out or silent, and of an
    overload; dropped_share: as of `Outcome`.
    """

    failure: Failure
    onset: Onset
    unmatched: Onset
    evidence: Evidence
    running: LoadedMap | None
    cut: FailureCut | None = None
    flags: tuple[str, ...] = ()
    dropped_share: float = 0.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """Results of one frame.

    cpu_s: from received images to estimate; stage_s: the same by stage. dock_error_m: from `DockCheck`, None without
    an arrival. speed_mps: by the wheels, else by the odometry, None if unknown. may_be_mapped: False if the robot is not localized and
    the map has no tile nearby. left_out: flags of disabled sensors, which contradict all others, of a silent IMU, and of an overload, with
    texts. dropped_share: of the frames of the last seconds, dropped before they were handled.
    """

    estimate: Estimate
    published: PublishedPose
    cpu_s: float
    stage_s: dict[str, float]
    failure: FailureContext | None
    dock_error_m: float | None = None
    speed_mps: float | None = None
    may_be_mapped: bool = True
    left_out: Mapping[Flag, str] = field(default_factory=dict)
    dropped_share: float = 0.0

    def pose_message(self) -> PoseMessage | None:
        """Return the pose for the server; None while there is no single one with a covariance, or it is in another site's map."""
        estimate, map_from_base, cov = self.estimate, self.published.map_from_base, self.published.cov_rot_trans
        if map_from_base is None or cov is None or not estimate.is_at_home:
            return None
        return PoseMessage.of(estimate.stamp_ns, map_from_base, cov, estimate.status, estimate.map_version)


class ImagePriors(Protocol):
    """Tells a robot its place by its images, as a plug-in."""

    def priors(self, frame: RectifiedFrame) -> list[PositionPrior]:
        """Return what a frame tells, before it is localized."""

    def judge(self, estimate: Estimate) -> str:
        """Compare what the frame told with its estimate; return a text that names what is left out from now on, empty for nothing."""


class Robot:
    """Feeds sensor bundles and maps to the localizer and keeps two versions while one of them is on trial."""

    def __init__(
        self,
        rectifier: Rectifier,
        settings: LocalizerSettings,
        trial: TrialSettings,
        clock_s: Clock = lambda: 0.0,
        *,
        keeps_replay: bool = False,
        image_priors: Sequence[ImagePriors] = (),
    ) -> None:
        """clock_s: measures CPU time; the default measures nothing. keeps_replay: record the seconds around a failure."""
        self._rectifier, self._clock_s, self._image_priors = rectifier, clock_s, image_priors
        calibration = rectifier.calibration
        self.base_from_body = calibration.base_from_body
        self.localizer = Localizer(rectifier.rig, settings, clock_s)
        self.ring = FailureRing() if keeps_replay else None
        self.versions = VersionTrials(trial, self._show)
        self._odom = ContinuousOdom(calibration.base_from_body)
        self.monitor = FailureMonitor()
        self._docks = motion_checks.DockCheck(calibration.base_from_body)
        self._onsets = OnsetRecorder()
        self._last: tuple[RectifiedFrame, Estimate] | None = None
        self._speed = motion_checks.SpeedGauge()
        self._load = motion_checks.Load()
        self._wheels = motion_checks.WheelAgreement(calibration.base_from_body)
        self._views = motion_checks.ExchangedViews(calibration, rectifier.mounted)
        self._images_refused = dict[Flag, str]()
        self._imu_ns = 0  # of the last sample, by the clock of images
        self._silent_ns = 0  # from it to the last frame
        self._set_back: Mapping[Flag, str] = {}  # sensors whose clock was
        self._wheels_fault, self._wheels_unused = calibration.wheels_fault, dict[Flag, str]()
        self._aligned: BuildingFrame | None = None
        self._of_version: BuildingFrame | None = None
        self.building: Mapping[str, Floor] = {}  # by `Localizer.handle_building`
        self.visited: dict[str, LoadedMap] = {}  # maps of its other sites
        self._site = ""  # whose map the last estimate is in

    @property
    def running(self) -> LoadedMap | None:
        """Return the map of the site where the robot is."""
        return self.visited.get(self._site) if self._site else self.versions.running

    def use(self, loaded: LoadedMap) -> None:
        """Use other tiles of a held version, or a new version: the first one is adopted at once, any other is put on trial."""
        self.versions.use(loaded)

    def use_building(
        self, building: Mapping[str, Floor], maps: Sequence[LoadedMap], frame: BuildingFrame | None = None
    ) -> None:
        """Use the robot's building, as `Localizer.handle_building`, and new versions of its other sites.

        Those are used without a trial: they are current on their own site, where its robots have tried them. frame: the pose of the map of
        a site without floors, which overrides that of versions.
        """
        self._aligned = frame
        if building is not self.building:  # it changes less often than maps
            self.building = building
            self.visited = {site: held for site, held in self.visited.items() if site in building}
            self.localizer.handle_building(building)
        for loaded in maps:
            self.visited[loaded.wanted.site] = loaded
            loaded.show(self.localizer, loaded.wanted.site)

    def handle(self, bundle: SensorBundle) -> Outcome | None:
        """Return results of a bundle with a frame; None without one that the localizer uses. RecordingError for unreadable images."""
        wheel = self._take_samples(bundle)
        if bundle.frame is None:
            return None
        begun_s = self._clock_s()
        raw = decode_frame(bundle.frame) if isinstance(bundle.frame, StoredFrame) else bundle.frame
        decoded_s = self._clock_s()
        frame = self._rectifier.rectify(raw)
        rectified_s = self._clock_s()
        if self.localizer.perception.awaits(frame):
            return None
        self._imu_ns = self._imu_ns or frame.stamp_ns
        self._silent_ns = frame.stamp_ns - self._imu_ns
        for prior in [prior for source in self._image_priors for prior in source.priors(frame)]:
            self.localizer.handle_prior(prior)
            if self.ring is not None:
                self.ring.handle_prior(prior)
        estimate = self.localizer.handle_stereo(frame)
        moved = "; ".join(filter(None, (source.judge(estimate) for source in self._image_priors)))
        refused = {Flag.PRIOR_REFUSED: moved} if moved else {}
        cpu_s = self._clock_s() - begun_s
        self._load.handle(estimate.stamp_ns, bundle.dropped)
        is_open = estimate.status is not Status.TRACKING and estimate.map_version is not None
        if is_open and self._load.overload and estimate.cause in _MAY_BE_OVERLOAD:
            estimate = replace(estimate, cause=Cause.OVERLOADED)
        stage_s = {"decode": decoded_s - begun_s, "rectify": rectified_s - decoded_s, **estimate.stage_s}
        self._last = (frame, estimate)
        if estimate.floor != self._site:
            self._site = estimate.floor
            if self.ring is not None and self.running is not None:  # recordings of failures need the map
                self.ring.use(self.running, self._site)
        level = self.building[self._site].entry.level if self.building else ""
        published = self._odom.handle(estimate)._replace(building_from_map=self._building_from_map(), level=level)
        odom_from_body = published.odom_from_base @ self.base_from_body
        if estimate.is_at_home:
            self.versions.handle(estimate, odom_from_body)
        else:
            self.versions.pause()
        speed_mps = self._speed.handle(wheel, estimate.odometry, published.odom_from_base)
        rolled = wheel if self._wheels_fault else bundle.wheel
        odometry, percept = self.localizer.perception.odometry, self.localizer.perception.percept
        if isinstance(odometry, WheelOdometry):
            base_from_cam = self.base_from_body @ self._rectifier.body_from_cam
            self._wheels.handle_way(rolled, odometry.wheels.seen_way, base_from_cam)
        else:
            self._wheels.handle(rolled, estimate.odometry)
        self._images_refused = self._views.refused(self._wheels, odometry.accelerometer)
        self.localizer.handle_contradiction("".join(self._images_refused.values()))
        is_covered = self._may_be_mapped(estimate)
        failure = self.monitor.handle(estimate, speed_mps, may_be_mapped=is_covered)
        if self.ring is not None and percept is not None:
            self.ring.handle(percept, frame, estimate, self.localizer.start(), self.monitor.begun_ns)
        context = None if failure is None else self._context(failure, odom_from_body)
        self._onsets.handle(estimate, frame, odom_from_body, self.monitor.begun_ns)
        dock_error_m = self._docks.handle(bundle.priors, estimate, odom_from_body)
        return Outcome(
            estimate, published, cpu_s, stage_s, context, dock_error_m, speed_mps, is_covered,
            {**self._left_out(), **refused}, self._load.dropped_share,
        )  # fmt: skip

    def _take_samples(self, bundle: SensorBundle) -> Sequence[WheelSample]:
        """Pass on what arrived beside the frame, and return the samples of wheels that may be used."""
        self._set_back = bundle.left_out
        self.localizer.handle_imu(bundle.imu)
        if len(bundle.imu):
            self._imu_ns = int(bundle.imu.stamps_ns[-1]) - int(self._rectifier.imu_minus_cam_s * 1e9)
        if bundle.wheel and self._wheels_fault and not self._wheels_unused:
            self._wheels_unused = {Flag.WHEELS_UNMOUNTED: f"the wheels are left out: {self._wheels_fault}"}
        wheel = [] if self._wheels.is_doubted or self._wheels.is_refused or self._wheels_fault else bundle.wheel
        self.localizer.handle_wheel(wheel)
        if self.ring is not None:
            self.ring.handle_samples(replace(bundle, wheel=wheel))
        if bundle.forget:
            self.localizer.forget_pose()
        for prior in bundle.priors:
            self.localizer.handle_prior(prior)
        return wheel

    def _left_out(self) -> dict[Flag, str]:
        odometry = self.localizer.perception.odometry
        if self._images_refused:
            return {**self._images_refused, **self._wheels_unused, **self._load.overload, **self._set_back}
        wheels = self._wheels.refused or self._wheels_unused
        imu = motion_checks.imu_refused(odometry.clock.off_s) if odometry.refuses_imu else {}
        if self._rectifier.calibration.imu and not imu and Flag.IMU_REFUSED not in self._set_back:
            imu = motion_checks.imu_silent(self._silent_ns)
        accelerometer = motion_checks.accelerometer_refused(odometry.accelerometer.fault)
        return {**imu, **accelerometer, **wheels, **self._load.overload, **self._set_back}

    def handle_silence(self, for_s: float) -> FailureContext | None:
        """Return the failure of a source without frames for so many seconds."""
        failure = self.monitor.handle_silence(for_s)
        context = None if failure is None else self._context(failure, None)
        if context is not None and self.ring is not None:
            self.ring.finish()
        return context

    def _may_be_mapped(self, estimate: Estimate) -> bool:
        """Return True if the map covers the robot's place, or may cover it."""
        if estimate.status is Status.TRACKING or estimate.map_from_body is None or self.running is None:
            return True
        # From farther away than the size of a tile, the survey did not observe its landmarks.
        manifest = self.running.manifest
        reach_m = radius_95_m(estimate.cov_rot_trans) + manifest.tile_size_m
        return bool(tiles_within(manifest, estimate.map_from_body[:3, 3], reach_m))

    def _context(self, failure: Failure, odom_from_body: Array | None) -> FailureContext:
        """Return the context of a failure. odom_from_body: of the frame of its detection, None without one."""
        assert self._last is not None
        frame, began_ns = self._last[0], failure.stamp_ns
        evidence = Evidence()
        if odom_from_body is not None:
            evidence = self._onsets.evidence(failure.estimate, failure.kind, began_ns, odom_from_body)
        failure = failure._replace(cause=refined_cause(failure.cause, evidence))
        was_carried = failure.cause is Cause.CARRIED
        onset = self._onsets.onset(failure.kind, began_ns, frame, was_carried=was_carried)
        lasted_s = failure.duration_s + max(0, began_ns - onset.stamp_ns) * 1e-9
        failure = failure._replace(stamp_ns=min(began_ns, onset.stamp_ns), duration_s=lasted_s)
        unmatched = onset if was_carried else self._onsets.open.get(FailureKind.NOT_FOUND, onset)
        cut = None if self.ring is None else self.ring.cut(failure.stamp_ns)
        flags = tuple(self._left_out())
        return FailureContext(failure, onset, unmatched, evidence, self.running, cut, flags, self._load.dropped_share)

    def _show(self, loaded: LoadedMap) -> None:
        if self.ring is not None and not self._site:
            self.ring.use(loaded)
        self._of_version = building_frame(loaded.manifest)
        loaded.show(self.localizer)

    def _building_from_map(self) -> Array | None:
        if self.building:
            return self.building[self._site].building_from_map
        frame = self._aligned or self._of_version
        return None if frame is None else frame.building_from_map
