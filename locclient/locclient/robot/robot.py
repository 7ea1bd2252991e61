"""One robot's life, frame by frame: localizes, watches for failures, tries new versions. No thread, file or socket of its own."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum

from fleetmap.geometry import Array
from fleetmap.messages import PoseMessage, WantedVersion
from fleetmap.recordings.images import StoredFrame, decode_frame
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import Image
from locclient.localization.estimate import Estimate
from locclient.localization.localizer import Localizer
from locclient.localization.settings import LocalizerSettings
from locclient.maps.loaded_map import LoadedMap
from locclient.robot.continuous_odom import ContinuousOdom, PublishedPose
from locclient.robot.dock_check import DockCheck
from locclient.robot.failure_monitor import Failure, FailureMonitor
from locclient.robot.sensor_bundle import SensorBundle
from locclient.robot.version_trial import TrialSettings, Verdict, VersionTrial

_THUMBNAIL_EVERY_NS = 1_000_000_000
_THUMBNAILS = 2


class Change(StrEnum):
    """What became of a version."""

    ADOPTED = "adopted"
    REFUSED = "refused"
    POSTPONED = "postponed"


@dataclass(frozen=True, slots=True)
class VersionChange:
    """A version that was adopted for good, refused for good, or put off because nothing could be seen; reason in words."""

    wanted: WantedVersion
    change: Change
    reason: str = ""


@dataclass(frozen=True, slots=True)
class FailureContext:
    """A failure with what a report of it shows: small earlier pictures, and all for the match view."""

    failure: Failure
    pictures: tuple[tuple[int, Image], ...]
    left: Image | None
    map_from_cam: Array | None
    running: LoadedMap | None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one frame brought. cpu_s: from encoded images to estimate. dock_error_m: as `DockCheck` says, None without an arrival."""

    estimate: Estimate
    published: PublishedPose
    cpu_s: float
    stage_s: dict[str, float]
    failure: FailureContext | None
    dock_error_m: float | None = None

    def pose_message(self) -> PoseMessage | None:
        """The pose for the server; None while there is no single one with a covariance."""
        estimate, map_from_odom = self.estimate, self.published.map_from_odom
        if map_from_odom is None or estimate.cov_rot_trans is None:
            return None
        map_from_base = map_from_odom @ self.published.odom_from_base
        return PoseMessage.of(
            estimate.stamp_ns, map_from_base, estimate.cov_rot_trans, estimate.status, estimate.map_version
        )


@dataclass
class _Versions:
    """good: the version whose fixes were confirmed; candidate: the one on trial.

    is_doubt: the good one is looked at again, because of what was said.
    """

    good: LoadedMap | None = None
    candidate: LoadedMap | None = None
    trial: VersionTrial | None = None
    is_doubt: bool = False
    said: str = ""
    changes: deque[VersionChange] = field(default_factory=deque)


class Robot:
    """Feeds sensor bundles and maps to the localizer and keeps two versions while one of them is on trial."""

    def __init__(
        self, calibration: RigCalibration, rectifier: Rectifier, settings: LocalizerSettings, trial: TrialSettings,
        clock_s: Callable[[], float] = lambda: 0.0,
    ) -> None:  # fmt: skip
        """clock_s measures CPU; the default measures nothing."""
        self._rectifier, self._clock_s = rectifier, clock_s
        self.base_from_body = calibration.base_from_body
        self.localizer = Localizer(
            calibration, rectifier.camera, rectifier.body_from_cam, rectifier.imu_minus_cam_s, settings, clock_s
        )
        self._trial_settings = trial
        self._versions = _Versions()
        self._odom = ContinuousOdom(calibration.base_from_body)
        self.monitor = FailureMonitor()
        self._docks = DockCheck(calibration.base_from_body)
        self._pictures: deque[tuple[int, Image]] = deque(maxlen=_THUMBNAILS)
        self._last: tuple[RectifiedFrame, Estimate] | None = None

    @property
    def held(self) -> list[LoadedMap]:
        """The versions in memory, the confirmed one first."""
        return [loaded for loaded in (self._versions.good, self._versions.candidate) if loaded is not None]

    @property
    def running(self) -> LoadedMap | None:
        """The version that the localizer looks at."""
        versions = self._versions
        return versions.good if versions.candidate is None or versions.is_doubt else versions.candidate

    def take_changes(self) -> list[VersionChange]:
        """What became of versions since the last call."""
        taken = list(self._versions.changes)
        self._versions.changes.clear()
        return taken

    def use(self, loaded: LoadedMap) -> None:
        """Other tiles of a version that is held, or a new version: the first is taken as it is, any other is tried."""
        versions = self._versions
        for name in ("good", "candidate"):
            held = getattr(versions, name)
            if held is not None and held.wanted == loaded.wanted:
                setattr(versions, name, loaded)
                if self.running is loaded:
                    self._show(loaded)
                return
        if not loaded.is_offer:
            return  # of a version that was given up while its tiles were read
        if versions.good is None:
            versions.good = loaded
            versions.changes.append(VersionChange(loaded.wanted, Change.ADOPTED))
        else:
            versions.candidate, versions.trial, versions.is_doubt = loaded, self._new_trial(), False
        self._show(loaded)

    def handle(self, bundle: SensorBundle) -> Outcome | None:
        """What a bundle with a frame brought; None without one. RecordingError for pictures that cannot be read."""
        self.localizer.handle_imu(bundle.imu)
        self.localizer.handle_wheel(bundle.wheel)
        for prior in bundle.priors:
            self.localizer.handle_prior(prior)
        if bundle.frame is None:
            return None
        begun_s = self._clock_s()
        raw = decode_frame(bundle.frame) if isinstance(bundle.frame, StoredFrame) else bundle.frame
        decoded_s = self._clock_s()
        frame = self._rectifier.rectify(raw)
        rectified_s = self._clock_s()
        estimate = self.localizer.handle_stereo(frame)
        cpu_s = self._clock_s() - begun_s
        stage_s = {"decode": decoded_s - begun_s, "rectify": rectified_s - decoded_s, **estimate.stage_s}
        self._try(estimate, frame)
        failure = self.monitor.handle(estimate)
        context = None if failure is None else self._context(failure)
        if not self._pictures or estimate.stamp_ns - self._pictures[-1][0] >= _THUMBNAIL_EVERY_NS:
            self._pictures.append((estimate.stamp_ns, frame.left))
        dock_error_m = self._docks.handle(bundle.priors, estimate)
        return Outcome(estimate, self._odom.handle(estimate), cpu_s, stage_s, context, dock_error_m)

    def handle_silence(self, for_s: float) -> FailureContext | None:
        """The failure that a source which sends no frames is."""
        failure = self.monitor.handle_silence(for_s)
        return None if failure is None else self._context(failure)

    def _context(self, failure: Failure) -> FailureContext:
        assert self._last is not None
        frame, estimate = self._last
        map_from_body = estimate.map_from_body
        map_from_cam = None if map_from_body is None else map_from_body @ self._rectifier.body_from_cam
        return FailureContext(failure, tuple(self._pictures), frame.left, map_from_cam, self.running)

    def _show(self, loaded: LoadedMap) -> None:
        focal_px = loaded.manifest.camera.focal_px
        self.localizer.handle_version(loaded.version, loaded.tiles.values(), loaded.vocabulary, focal_px)

    def _new_trial(self) -> VersionTrial | None:
        """From the last frame that was looked at with the version before; without any, from the first one to come."""
        return None if self._last is None else VersionTrial(self._trial_settings, self._last[1])

    def _try(self, estimate: Estimate, frame: RectifiedFrame) -> None:
        """Counts the frame for the trial that is on, if any."""
        self._last = (frame, estimate)
        versions = self._versions
        if versions.candidate is None:
            return
        if versions.trial is None:
            versions.trial = VersionTrial(self._trial_settings, estimate)
        verdict = versions.trial.handle(estimate)
        if verdict is Verdict.UNDECIDED:
            return
        if versions.is_doubt:
            self._end_doubt(verdict)
        elif verdict is Verdict.CONFIRMED:
            versions.changes.append(VersionChange(versions.candidate.wanted, Change.ADOPTED))
            self._versions = replace(versions, good=versions.candidate, candidate=None, trial=None)
        else:
            assert versions.good is not None
            self._show(versions.good)
            self._versions = replace(versions, trial=self._new_trial(), is_doubt=True, said=versions.trial.said)

    def _end_doubt(self, verdict: Verdict) -> None:
        """The old version gave fixes where the new one gave none, or it did not either."""
        versions = self._versions
        assert versions.candidate is not None
        assert versions.good is not None
        said = f"of version {versions.candidate.version} {versions.said}"
        if verdict is Verdict.CONFIRMED:
            reason = f"{said}, where version {versions.good.version} gives fixes"
            versions.changes.append(VersionChange(versions.candidate.wanted, Change.REFUSED, reason))
        else:
            reason = f"{said}, and version {versions.good.version} gives no fixes either; it is tried again later"
            versions.changes.append(VersionChange(versions.candidate.wanted, Change.POSTPONED, reason))
        self._versions = replace(versions, candidate=None, trial=None, is_doubt=False)
