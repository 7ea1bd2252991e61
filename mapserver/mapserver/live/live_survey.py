"""A survey under way: frames are tracked as they come, the map grows beside, everybody may look, and a build ends it."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.errors import FleetmapError, UsageError
from fleetmap.live_survey import LiveSurveyState
from fleetmap.recordings import Recording
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import SensorSet
from mapserver.build.build import BuildOptions, read_zones
from mapserver.build.worker import read_ahead
from mapserver.library import BuiltMap, build_map
from mapserver.live.mapping_process import MOST_PLACES, MappingProcess, MapSketch, thinning
from mapserver.survey.live.live_map import LiveRig
from mapserver.survey.live.tracking import LiveTracking, Tracked
from mapserver.survey.loops.zones import Zones
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs

Tell = Callable[[LiveSurveyState], None]

_TELL_EVERY_S = 0.5
_WARM_UP_FRAMES = 3
_BEGIN_S = 0.2  # the first frame is due so long after all is ready
_AHEAD = 8  # decoded frames that wait


@dataclass(frozen=True)
class LiveRequest:
    """A survey to follow.

    recording: played at `speed` times its own; 0 for as fast as it goes. options: of the build at the end, whose frames are followed.
    """

    recording: Path
    site: str
    store: Path
    settings: SurveySettings
    options: BuildOptions = field(default_factory=BuildOptions)
    speed: float = 1.0


class LiveFigures(NamedTuple):
    """How the survey kept up: frames and the seconds that they last; 0.5 and 0.99 of the frames were answered within latency_ms, None
    where they were not played at their own speed; late_frames took longer than the time to the next one; the most keyframes behind.
    """

    frames: int
    seconds: float
    keyframes: int
    latency_ms: tuple[float, float] | None
    late_frames: int
    most_behind: int
    loops: int
    mapping_failed: str

    def words(self) -> str:
        """A sentence."""
        kept = "played as fast as it went"
        if self.latency_ms is not None:
            kept = f"answered within {self.latency_ms[1]:.0f} ms (99 %), {self.late_frames} late"
        return (
            f"live: {self.frames} frames of {self.seconds:.1f} s, {kept}; {self.keyframes} keyframes, mapping at most "
            f"{self.most_behind} behind, {self.loops} loops{'; ' + self.mapping_failed if self.mapping_failed else ''}"
        )


class LiveResult(NamedTuple):
    """What the survey saw while it drove, and the draft that was made of it."""

    figures: LiveFigures
    built: BuiltMap


def run_live(request: LiveRequest, tell: Tell, is_stopped: Callable[[], bool], console: Console) -> LiveResult:
    """Follows a survey to its end, or until it is stopped, and builds the draft of what was seen.

    tell: takes the state, twice a second. Raises the FleetmapErrors of a build, UsageError for what cannot be mapped live.
    """
    if not (np.isfinite(request.speed) and request.speed >= 0):
        raise UsageError(f"--speed {request.speed}: give 1 for the recording's own speed, 0 for as fast as it goes")
    with request.options.reading.open(request.recording) as (recording, indices):
        survey = _Survey(request, recording, indices, tell)
        survey.follow(is_stopped)
    console.print(survey.figures().words(), markup=False)
    survey.say("adjusting")
    seen = replace(request.options, frames=survey.frames_seen(), settings=request.settings)
    try:
        built = build_map(request.recording, request.store, request.site, seen)
    except FleetmapError as error:
        survey.say("failed", words=str(error))
        raise
    survey.say("stored", version=built.version, words=built.sentence)
    return LiveResult(survey.figures(), built)


class _Survey:
    """One survey while it drives, and what can be said of it."""

    def __init__(self, request: LiveRequest, recording: Recording, indices: NDArray[np.int64], tell: Tell) -> None:
        """Raises UsageError for a camera without depth."""
        has_depth = recording.sensor_set is SensorSet.RGBD
        rectifier = Rectifier(recording.calibration, has_depth=has_depth)
        if rectifier.camera.baseline_m == 0 and not has_depth:
            raise UsageError(
                f"{recording.path}: one camera alone gives no depths before its survey is over, so that no map can grow; build it"
            )
        self._request, self._recording, self._indices, self._tell = request, recording, indices, tell
        self._rectifier = rectifier
        self._inputs = SurveyInputs((), len(indices), recording.imu, recording.calibration, rectifier, recording.wheel)
        rig = recording.calibration
        self._rig = LiveRig(rectifier.camera, rectifier.body_from_cam, rig.imu, rectifier.imu_minus_cam_s, has_depth)
        self._stamps_ns = recording.frame_stamps_ns[indices]
        self._count, self._most_behind = 0, 0
        self._latencies_s: list[float] = []
        self._qualities: list[float] = []  # of each keyframe, the worst since the one before
        self._worst = 1.0
        self._sketch: MapSketch | None = None
        self._behind, self._failed = 0, ""

    def follow(self, is_stopped: Callable[[], bool]) -> None:
        """Tracks all frames, each when it is due."""
        request = self._request
        zones = Zones() if request.options.zones is None else read_zones(request.options.zones)
        options = SurveyConfig(request.settings, default_vocabulary(), zones)
        warm_up = tuple(self._frame(int(index)) for index in self._indices[:_WARM_UP_FRAMES])
        scratch = LiveTracking(self._inputs, request.settings)
        for frame in warm_up:
            scratch.handle(frame)
        with MappingProcess(options, self._rig, warm_up) as mapping:
            tracking = LiveTracking(self._inputs, request.settings)
            self._track(tracking, mapping, is_stopped)
            mapping.finish()
            self._look(mapping)

    def _track(self, tracking: LiveTracking, mapping: MappingProcess, is_stopped: Callable[[], bool]) -> None:
        frames = read_ahead(self._frames(), _AHEAD)
        begin_s = time.monotonic() + _BEGIN_S
        told_s = begin_s
        for frame in frames:
            if is_stopped():
                break
            due_s = self._due_s(begin_s, frame.stamp_ns)
            if due_s is not None and (early_s := due_s - time.monotonic()) > 0:
                time.sleep(early_s)
            self._take(tracking.handle(frame), mapping)
            now_s = time.monotonic()
            if due_s is not None:
                self._latencies_s.append(now_s - due_s)
            self._look(mapping)
            if now_s - told_s >= _TELL_EVERY_S:
                told_s = now_s
                self.say("tracking")

    def _due_s(self, begin_s: float, stamp_ns: int) -> float | None:
        """When a frame comes, on the monotonic clock; None where frames come as fast as they are taken."""
        speed = self._request.speed
        return None if speed == 0 else begin_s + (stamp_ns - int(self._stamps_ns[0])) * 1e-9 / speed

    def _frame(self, index: int) -> RectifiedFrame:
        return self._rectifier.rectify(self._recording.read_frame(index))

    def _frames(self) -> Iterator[RectifiedFrame]:
        return (self._frame(int(index)) for index in self._indices)

    def _take(self, tracked: Tracked, mapping: MappingProcess) -> None:
        self._count += 1
        self._worst = min(self._worst, tracked.quality)
        if tracked.keyframe is not None:
            mapping.put(tracked.frame, tracked.keyframe)
            self._qualities.append(self._worst)
            self._worst = 1.0

    def _look(self, mapping: MappingProcess) -> None:
        self._sketch, self._behind, self._failed = mapping.sketch, mapping.behind, mapping.failed
        self._most_behind = max(self._most_behind, self._behind)

    def frames_seen(self) -> str:
        """The slice of the recording that was tracked, as `--frames` says it."""
        if self._count == len(self._indices):
            return self._request.options.frames
        seen = self._indices[: max(self._count, 1)]
        step = int(self._indices[1] - self._indices[0]) if len(self._indices) > 1 else 1
        return f"{int(seen[0])}:{int(seen[-1]) + 1}:{step}"

    def figures(self) -> LiveFigures:
        """How the survey has kept up until now."""
        latency = None
        if self._latencies_s:
            median, high = np.percentile(self._latencies_s, [50, 99]) * 1e3
            latency = round(float(median), 2), round(float(high), 2)
        sketch = self._sketch
        return LiveFigures(
            frames=self._count,
            seconds=self._seconds(),
            keyframes=len(self._qualities),
            latency_ms=latency,
            late_frames=self._late(),
            most_behind=self._most_behind,
            loops=0 if sketch is None else sketch.loops,
            mapping_failed=self._failed,
        )

    def _seconds(self) -> float:
        return float(self._stamps_ns[max(self._count - 1, 0)] - self._stamps_ns[0]) * 1e-9

    def _late(self) -> int:
        if not self._latencies_s or self._request.speed == 0 or len(self._stamps_ns) < 2:
            return 0
        interval_s = float(np.median(np.diff(self._stamps_ns))) * 1e-9 / self._request.speed
        return int(np.sum(np.array(self._latencies_s) > interval_s))

    def say(self, phase: str, *, version: int | None = None, words: str = "") -> None:
        """Tells the state."""
        figures, sketch = self.figures(), self._sketch
        assert sketch is not None
        qualities = np.array(self._qualities[: sketch.keyframes])[thinning(sketch.keyframes, MOST_PLACES)]
        self._tell(
            LiveSurveyState(
                site=self._request.site,
                recording=self._recording.name[:200],
                stamp_ns=int(self._stamps_ns[max(self._count - 1, 0)]),
                phase=phase,
                seconds=round(figures.seconds, 3),
                frames=figures.frames,
                keyframes=figures.keyframes,
                behind=self._behind,
                latency_ms=None if figures.latency_ms is None else figures.latency_ms[1],
                late_frames=figures.late_frames,
                path_m=sketch.path_m.astype("<f4").tobytes(),
                quality=np.round(255 * np.clip(qualities, 0, 1)).astype(np.uint8).tobytes(),
                landmarks_m=sketch.landmarks_m.astype("<f4").tobytes(),
                loops_m=sketch.loops_m.astype("<f4").tobytes(),
                loops=sketch.loops,
                refused=sketch.refused,
                version=version,
                words=(words or self._failed)[:2000],
            )
        )
