"""Ring of the last seconds: what the localizer perceived, what it answered, and a few pictures, kept for the replay of a failure. Pure.

The odometry knows no map: its estimates are kept as they were, not its samples alone, so that no image is needed to repeat what the map
made of them. States of the localizer are taken about once a second, between two map queries; a replay begins at one of them.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array
from fleetmap.messages import FailureKind
from fleetmap.numerics.time_sliced import TimeSliced
from fleetmap.odometry import OdometryEstimate
from fleetmap.relocalization.frame_features import FrameFeatures
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, PositionPrior, WheelSample
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.localization.calibration.parameters import NOT_JUDGED, CalibrationState
from locclient.localization.estimate import Estimate
from locclient.localization.image_quality import ImageQuality
from locclient.localization.localizer import Localizer
from locclient.localization.localizer_state import LocalizerState
from locclient.maps.loaded_map import LoadedMap

BEFORE_NS, AFTER_NS = 5_000_000_000, 5_000_000_000  # of a failure's onset
_SEGMENT_NS = 1_000_000_000  # between two states
_PICTURES_NS, _LATEST_PICTURE_NS = 450_000_000, 900_000_000  # between two, of map queries and of any frame
_SAME_ONSET_NS = 3_500_000_000  # a carried robot's onset is the break of its odometry, up to three seconds earlier
_MAX_FRAMES = 1000  # 90 a second: a camera that is faster has a shorter ring
_NO_TRACKS = np.zeros(0, np.int64)

Motions = dict[int, tuple[Array, Array] | None]


@dataclass(frozen=True, slots=True)
class UsedMap:
    """The map that the localizer used: its version, and the cells of its tiles in their order."""

    version: int
    manifest_sha256: str
    cells: tuple[tuple[int, int], ...]


@dataclass(slots=True, eq=False)
class KeptQuery:
    """A map query that began with a frame: its features, None while they are extracted, and in how many slices that was done."""

    slices: int = 0
    features: FrameFeatures | None = None


@dataclass(slots=True, eq=False)
class Inputs:
    """What came before a frame. used, forgets, priors: in this order."""

    used: UsedMap | None = None
    forgets: bool = False
    priors: list[PositionPrior] = field(default_factory=list)
    imu: list[ImuSamples] = field(default_factory=list)
    wheel: list[WheelSample] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class Said:
    """What the robot said of a frame; map_from_body (4, 4), None with radius_95_m while it claimed no pose."""

    status: str
    cause: str
    map_from_body: Array | None
    radius_95_m: float | None

    @classmethod
    def of(cls, estimate: Estimate) -> "Said":
        radius_m = None if estimate.cov_rot_trans is None else radius_95_m(estimate.cov_rot_trans)
        return cls(estimate.status.value, estimate.cause.value, estimate.map_from_body, radius_m)


@dataclass(slots=True, eq=False)
class KeptFrame:
    """All that the localizer perceived in one frame, and said.

    motions, forgotten: answers of the odometry by frame. picture: its images, for a few frames only.
    """

    inputs: Inputs
    odometry: OdometryEstimate
    image: ImageQuality
    motions: Motions = field(default_factory=dict)
    forgotten: dict[int, bool] = field(default_factory=dict)
    is_reversed: bool = False
    calibration: CalibrationState = NOT_JUDGED
    query: KeptQuery | None = None
    said: Said | None = None
    picture: RectifiedFrame | None = None

    @property
    def stamp_ns(self) -> int:
        return self.odometry.stamp_ns


@dataclass(slots=True, eq=False)
class Segment:
    """A state of the localizer in a map, and the frames since."""

    state: LocalizerState
    used: UsedMap | None
    frames: list[KeptFrame] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class FailureCut:
    """The part of the ring around an onset; segments is None until all of it has come. is_wanted: of a failure that was reported."""

    onset_ns: int
    is_wanted: bool = True
    segments: tuple[Segment, ...] | None = None


class FailureRing:
    """The perception of a localizer, followed: each answer is passed on and kept. For the thread that localizes; cuts are for any."""

    def __init__(self, localizer: Localizer) -> None:
        """Puts itself between the localizer and its perception."""
        self._localizer, self._inner = localizer, localizer.perception
        localizer.perception = self
        self.add, self.give_up, self.judged = self._inner.add, self._inner.give_up, self._inner.judged
        self._segments: deque[Segment] = deque()
        self._inputs = Inputs()
        self._used: UsedMap | None = None
        self._frame: KeptFrame | None = None
        self._seen: RectifiedFrame | None = None
        self._cuts: list[FailureCut] = []  # that are not complete
        self._held: FailureCut | None = None  # of what goes on and may become a failure
        self._query: KeptQuery | None = None  # the last one
        self._query_index: int | None = None  # its frame
        self._pictured_ns = -(2**62)

    def use(self, loaded: LoadedMap) -> None:
        """The localizer takes these tiles before the next frame."""
        used = UsedMap(loaded.version, loaded.wanted.manifest_sha256 or "", tuple(loaded.tiles))
        self._used = self._inputs.used = used

    def handle_commands(self, bundle: SensorBundle) -> None:
        """What a bundle says of the place before its frame."""
        self._inputs.forgets |= bundle.forget
        if bundle.forget:
            self._inputs.priors.clear()
        self._inputs.priors.extend(bundle.priors)

    def handle(self, estimate: Estimate, begun_ns: Mapping[FailureKind, int]) -> None:
        """Ends a frame. begun_ns: since when what may become a failure goes on, by kind."""
        frame = self._frame
        assert frame is not None
        frame.calibration = estimate.calibration._replace(drifts=())
        frame.said = Said.of(estimate)
        if self._query_index is not None and self._query_index not in frame.motions:
            # Another version may find a fix in the last query's frame, and go on from there.
            frame.motions[self._query_index] = self._inner.motion_since(self._query_index)
        self._note_picture(frame)
        self._segments[-1].frames.append(frame)
        now_ns = frame.stamp_ns
        self._follow_onsets(begun_ns)
        for cut in [cut for cut in self._cuts if now_ns >= cut.onset_ns + AFTER_NS]:
            self._complete(cut)
        if now_ns - self._segments[-1].frames[0].stamp_ns >= _SEGMENT_NS:
            self._begin_segment()
        self._forget_before(now_ns - BEFORE_NS - AFTER_NS)

    def cut(self, onset_ns: int) -> FailureCut:
        """What was and will be kept around the onset of a failure."""
        held = self._held
        if held is not None and abs(held.onset_ns - onset_ns) <= _SAME_ONSET_NS:
            held.is_wanted = True
            return held
        cut = FailureCut(onset_ns)
        self._cuts.append(cut)
        return cut

    def finish(self) -> None:
        """No frame follows: completes what waits."""
        for cut in list(self._cuts):
            self._complete(cut)

    # --- as Perception ------------------------------------------------------------------------------------------------

    def handle_imu(self, samples: ImuSamples) -> None:
        self._inputs.imu.append(samples)
        self._inner.handle_imu(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        self._inputs.wheel.extend(samples)
        self._inner.handle_wheel(samples)

    def judge(self, frame: RectifiedFrame) -> tuple[RectifiedFrame, ImageQuality]:
        self._seen = frame
        if not self._segments:  # priors and maps until now are in the state
            self._begin_segment()
            self._inputs = Inputs(imu=self._inputs.imu, wheel=self._inputs.wheel)
        return self._inner.judge(frame)

    def follow(self, frame: RectifiedFrame, image: ImageQuality) -> tuple[OdometryEstimate, ImageQuality]:
        odometry, image = self._inner.follow(frame, image)
        kept = replace(odometry, track_ids=_NO_TRACKS, track_pixels=None, revised=())
        self._frame, self._inputs = KeptFrame(self._inputs, kept, image), Inputs()
        return odometry, image

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        assert self._frame is not None
        found = self._frame.motions[frame_index] = self._inner.motion_since(frame_index)
        return found

    def will_forget(self, frame_index: int) -> bool:
        assert self._frame is not None
        found = self._frame.forgotten[frame_index] = self._inner.will_forget(frame_index)
        return found

    def is_reversed(self, frame: RectifiedFrame, *, is_localized: bool) -> bool:
        assert self._frame is not None
        found = self._frame.is_reversed = self._inner.is_reversed(frame, is_localized=is_localized)
        return found

    def extract(self, relocalizer: Relocalizer, frame: RectifiedFrame) -> TimeSliced[FrameFeatures]:
        assert self._frame is not None
        if self._query is not None and self._query.features is not None:
            self._query.features.frame = None  # nothing more is measured in it
        query = self._query = self._frame.query = KeptQuery()
        self._query_index = self._frame.odometry.frame_index
        work = self._inner.extract(relocalizer, frame)
        while True:
            try:
                next(work)
            except StopIteration as done:
                query.features = done.value
                return query.features
            query.slices += 1
            yield

    # --- the ring -----------------------------------------------------------------------------------------------------

    def _begin_segment(self) -> None:
        state = self._localizer.capture()
        if state is not None:
            self._segments.append(Segment(state, self._used))

    def _note_picture(self, frame: KeptFrame) -> None:
        since_ns = frame.stamp_ns - self._pictured_ns
        if since_ns >= (_PICTURES_NS if frame.query is not None else _LATEST_PICTURE_NS):
            self._pictured_ns, frame.picture = frame.stamp_ns, self._seen
        self._seen = None

    def _follow_onsets(self, begun_ns: Mapping[FailureKind, int]) -> None:
        if self._held is not None and self._held.onset_ns not in begun_ns.values():
            if self._held in self._cuts and not self._held.is_wanted:
                self._cuts.remove(self._held)
            self._held = None
        if self._held is None and begun_ns:
            self._held = FailureCut(min(begun_ns.values()), is_wanted=False)
            self._cuts.append(self._held)

    def _complete(self, cut: FailureCut) -> None:
        """Gives a cut its segments; what still changes is copied."""
        self._cuts.remove(cut)
        chosen = [
            part for part in self._segments if part.frames and part.frames[-1].stamp_ns >= cut.onset_ns - BEFORE_NS
        ]
        if not chosen:
            return
        last = replace(chosen[-1], frames=list(chosen[-1].frames))
        for place, frame in enumerate(last.frames):
            if frame.query is not None and frame.query.features is not None:
                features = frame.query.features
                tried = None if features.is_tried is None else features.is_tried.copy()
                copied = FrameFeatures(features.features, features.pixels.copy(), None, tried)
                last.frames[place] = replace(frame, query=KeptQuery(frame.query.slices, copied))
        cut.segments = (*chosen[:-1], last)

    def _forget_before(self, oldest_ns: int) -> None:
        frames = sum(len(part.frames) for part in self._segments)
        while len(self._segments) > 1 and (
            frames > _MAX_FRAMES or (self._segments[1].frames and self._segments[1].frames[0].stamp_ns <= oldest_ns)
        ):
            frames -= len(self._segments.popleft().frames)
