"""A live survey: frames are tracked as they arrive, the map grows in parallel, viewers may watch, and a build ends it.

Tracking is the survey's own odometry, frame by frame; its keyframes are the growing map's.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import NamedTuple

import cv2
import numpy as np
from msgspec import structs
from rich.console import Console

from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.errors import FleetmapError
from fleetmap.free_memory import gc_frozen
from fleetmap.geometry import Array, se3_inverse
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.recordings.images import jpeg_image
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import Image, ImuSamples, WheelSample
from mapserver.drafting.survey_recordings import read_zones
from mapserver.drafting.worker import single_threaded_libraries
from mapserver.library import BuiltMap, build_map
from mapserver.plugins.live_surveys import message
from mapserver.plugins.live_surveys.drives import Drive, DueFrame
from mapserver.plugins.live_surveys.mapping_process import MappingProcess
from mapserver.survey.odometry_pass import OdometryRun
from mapserver.survey.pose_graph.odometry_factors import FLOOR, INERTIAL_FLOOR, step_covariance
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyConfig, TrackedFrame

_TORN_M2 = 100.0
_TELL_EVERY_S = 0.5
_PICTURE_PX, _PICTURE_QUALITY = 320, 50  # of the longer side; 10 kB


class Tracked(NamedTuple):
    """Tracking result of one frame.

    quality: share of its consistent points, 0 while the odometry is lost; keyframe: its data for the map, None if it is not one;
    pixels (N, 3), u_left v u_right, of the tracked points, None without any.
    """

    frame: RectifiedFrame
    quality: float
    keyframe: message.NewKeyframe | None
    pixels: Array | None = None


class LiveTracking:
    """Processes every frame in order."""

    def __init__(self, calibration: RigCalibration, rectifier: Rectifier, settings: SurveySettings) -> None:
        self._run = OdometryRun(calibration, rectifier, settings)
        self._is_single, self._has_imu = rectifier.camera.baseline_m == 0, calibration.imu is not None
        self._torn_m2 = 0.0  # variance of the gaps between runs of one camera
        # Covariance and pose of the last keyframe, the gaps until then
        self._before: tuple[Array, Array, float] | None = None
        self._imu: list[ImuSamples] = []

    def handle(self, frame: RectifiedFrame, imu: ImuSamples, wheel: Sequence[WheelSample]) -> Tracked:
        """Track the next frame, with the new samples of the IMU and the wheels up to it."""
        tracked = self._run.handle(frame, imu, wheel)
        self._imu.append(imu)
        estimate = tracked.estimate
        keyframe = self._keyframe(tracked) if tracked.is_keyframe and self._has_place(estimate) else None
        quality = 0.0 if estimate.status is OdometryStatus.DEGRADED else float(estimate.inlier_share)
        return Tracked(tracked.frame, quality, keyframe, estimate.track_pixels)

    def _has_place(self, estimate: OdometryEstimate) -> bool:
        """True if the frame's pose relative to earlier ones is known: with one camera only after its start, with an IMU after scale."""
        if not self._is_single or (
            estimate.status is not OdometryStatus.INITIALISING and estimate.scale_known == self._has_imu
        ):
            return True
        if self._before is not None and not self._has_imu:
            self._torn_m2 += _TORN_M2  # a new start has its own scale
        return False

    def _keyframe(self, tracked: TrackedFrame) -> message.NewKeyframe:
        estimate, covariance, frame_from_body = tracked.estimate, self._run.chain.covariance, tracked.frame_from_body
        step_cov, imu = None, message.joined_imu(self._imu)
        if self._before is not None:
            cov_before, frame_before, torn_before_m2 = self._before
            least = INERTIAL_FLOOR if estimate.inertial else FLOOR
            step = se3_inverse(frame_before) @ frame_from_body
            step_cov = step_covariance((cov_before, covariance), frame_before[:3, :3], step, least)
            if self._torn_m2 > torn_before_m2:
                step_cov = step_cov + _TORN_M2 * np.eye(6)
        velocity_body_mps = estimate.odom_from_body[:3, :3].T @ estimate.velocity_odom_mps
        self._before = covariance, frame_from_body, self._torn_m2
        self._imu = []
        return message.NewKeyframe(
            number=tracked.number,
            frame_from_body=frame_from_body,
            level_from_frame=self._run.chain.level_from_frame,
            step_cov=step_cov,
            motion_body=np.r_[velocity_body_mps, estimate.gyro_bias_radps, estimate.accel_bias_mps2],
            inertial=estimate.inertial,
            imu=imu,
            variance_m2=float(np.trace(covariance[3:, 3:])) + self._torn_m2,
        )


Tell = Callable[[message.LiveSurveyState], None]
See = Callable[[Tracked], None]


class LiveFigures(NamedTuple):
    """A survey's state, and how well mapping kept up. most_behind: largest queue of keyframes; lag_s: longest time from a keyframe to the
    map that shows it. dropped: frames that arrived too fast."""

    state: message.LiveSurveyState
    most_behind: int
    lag_s: float
    dropped: int
    mapping_failed: str

    def words(self) -> str:
        state, failed = self.state, self.mapping_failed
        kept = "played as fast as possible"
        if state.latency_ms is not None:
            kept = f"answered within {state.latency_ms:.0f} ms (99 %), {state.late_frames} late"
        made = f"{state.loops} loops" + (f" in {len(state.parts)} separate parts" if len(state.parts) > 1 else "")
        return (
            f"live: {state.frames} frames of {state.seconds:.1f} s, {kept}, {self.dropped} dropped; {state.keyframes} keyframes, mapping "
            f"at most {self.most_behind} behind ({self.lag_s:.1f} s), {made}{'; ' if failed else ''}{failed}"
        )


def run_live(
    drive: Drive, tells: Sequence[Tell], is_stopped: Callable[[], bool], console: Console, see: See | None = None
) -> tuple[LiveFigures, BuiltMap]:
    """Run a survey to its end, or until it is stopped; return the figures of the drive, and the draft built from it.

    tells: receive the state, twice a second; see: receives every frame, and returns at once. Raises the FleetmapErrors of a build,
    before the drive if possible.
    """
    survey = _Survey(drive, tells, see)
    try:
        for remark in survey.check():
            console.print(remark, markup=False)
        survey.follow(is_stopped)
        console.print(survey.figures().words(), markup=False)
        options = drive.finish(survey.figures().state.frames)
        survey.say("adjusting")
        built = build_map(drive.request.recordings, drive.request.store, drive.request.site, options)
    except FleetmapError as error:
        survey.say("failed", words=str(error))
        raise
    survey.say("stored", version=built.version, words=built.sentence)
    return survey.figures(), built


class _Survey:
    """One survey during its drive, with its present figures."""

    def __init__(self, drive: Drive, tells: Sequence[Tell], see: See | None) -> None:
        self._drive, self._tells, self._see = drive, tells, see
        self._stamps_ns: list[int] = []
        self._latencies_s: list[float] = []
        self._qualities: list[float] = []  # of each keyframe, the worst since the previous one
        self._worst = 1.0
        self._seen: Image | None = None  # the newest keyframe
        # Also with an IMU: odometry finds the scale, but in one recording the map's adjustment halved it.
        self._scale_known = drive.rectifier.camera.baseline_m > 0
        self._mapping = MappingProcess(drive.rectifier)

    def check(self) -> list[str]:
        """Return shortcomings before the start as text; FleetmapErrors for a survey certain to fail."""
        remarks, zones = self._drive.check(), read_zones(self._drive.request.options.zones)
        self._config = SurveyConfig(self._drive.settings, default_vocabulary(), zones)
        if not self._scale_known and self._drive.calibration.imu is None:
            remarks.append(
                "scale: unknown: one camera without an IMU shows no metres; the draft can be inspected, and published only if docks or "
                "tags tell them. Record an IMU, a second camera or depths"
            )
        return remarks

    def follow(self, is_stopped: Callable[[], bool]) -> None:
        """Track all frames, each when it is due; call `check` first."""
        drive, told_s = self._drive, 0.0
        # One thread per process, and no garbage collection of the survey's objects: both would delay frames.
        with single_threaded_libraries(), gc_frozen(), closing(self._mapping.start(self._config)):
            tracking = LiveTracking(drive.calibration, drive.rectifier, drive.settings)
            with closing(drive.frames()) as frames:
                for due in frames:
                    if is_stopped():
                        break
                    if due is not None:
                        self._take(due, tracking)
                    if time.monotonic() - told_s >= _TELL_EVERY_S:
                        told_s = time.monotonic()
                        self.say("tracking")

    def _take(self, due: DueFrame, tracking: LiveTracking) -> None:
        tracked = tracking.handle(due.frame, due.imu, due.wheel)
        if due.due_s is not None:
            self._latencies_s.append(time.monotonic() - due.due_s)
        if self._see is not None:
            self._see(tracked)
        self._stamps_ns.append(due.frame.stamp_ns)
        self._worst = min(self._worst, tracked.quality)
        if tracked.keyframe is not None:
            self._mapping.put(due.frame, tracked.keyframe)
            self._qualities.append(self._worst)
            self._seen = due.frame.left
            self._worst = 1.0

    def figures(self) -> LiveFigures:
        mapping = self._mapping
        lag_s = round(mapping.longest_lag_s, 3)
        return LiveFigures(self.state("tracking"), mapping.most_behind, lag_s, self._drive.dropped, mapping.failed)

    def say(self, phase: str, *, version: int | None = None, words: str = "") -> None:
        state = self.state(phase, version, words)
        for tell in self._tells:
            tell(state)

    def state(self, phase: str, version: int | None = None, words: str = "") -> message.LiveSurveyState:
        sketch, stamps_ns = self._mapping.sketch, self._stamps_ns or [0]  # the thread of mapping replaces the sketch
        shown = message.thinning(sketch.keyframes, message.MOST_PLACES)
        qualities = np.array(self._qualities[: sketch.keyframes])[shown]
        latencies_s, late_frames = np.array(self._latencies_s), 0
        if len(latencies_s) > 1:  # processed later than the time to the next frame
            period_s = float(np.median(np.diff(stamps_ns))) * 1e-9 / self._drive.speed
            late_frames = int(np.sum(latencies_s > period_s))
        return message.LiveSurveyState(
            **structs.asdict(sketch) | {"keyframes": len(self._qualities)},
            site=self._drive.request.site,
            recording=self._drive.name[:200],
            stamp_ns=stamps_ns[-1],
            phase=phase,
            seconds=round((stamps_ns[-1] - stamps_ns[0]) * 1e-9, 3),
            frames=len(self._stamps_ns),
            behind=self._mapping.behind,
            latency_ms=round(float(np.percentile(latencies_s, 99) * 1e3), 2) if len(latencies_s) else None,
            late_frames=late_frames,
            quality=np.round(255 * np.clip(qualities, 0, 1)).astype(np.uint8).tobytes(),
            scale_known=self._scale_known,
            picture=self._picture(),
            version=version,
            words=(words or self._mapping.failed)[:2000],
        )

    def _picture(self) -> bytes:
        """Return the camera's latest image, scaled down."""
        if self._seen is None:
            return b""
        height, width = (-(-_PICTURE_PX * side // max(self._seen.shape)) for side in self._seen.shape)
        small = cv2.resize(self._seen, (width, height), interpolation=cv2.INTER_AREA)
        data = jpeg_image(np.asarray(small, np.uint8), _PICTURE_QUALITY).data
        return data if len(data) <= message.MAX_ARRAY_BYTES else b""
