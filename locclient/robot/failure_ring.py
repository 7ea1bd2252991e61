"""Ring of the last seconds: what the localizer perceived, what it answered, and a few pictures, kept for the replay of a failure. Pure.

The odometry knows no map: its estimates are kept as they were, not its samples alone, so that no image is needed to repeat what the map
made of them. A replay begins with the pose that the robot had then.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import atan2

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.failure_definition import radius_95_m
from fleetmap.failure_summary import Moment
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
from locclient.localization.localizer import Localizer, Start
from locclient.maps.loaded_map import LoadedMap

BEFORE_NS, AFTER_NS = 5_000_000_000, 5_000_000_000  # of a failure's onset
_QUERY_NS = 2_000_000_000  # longer than a map query lasts: a replay begins between two of them
_PICTURES_NS, _LATEST_PICTURE_NS = 450_000_000, 900_000_000  # between two, of map queries and of any frame
_SAME_ONSET_NS = 3_500_000_000  # a carried robot's onset is the break of its odometry, up to three seconds earlier
_MAX_FRAMES = 1000  # 90 a second: a camera that is faster has a shorter ring
_NO_TRACKS = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True)
class UsedMap:
    """The map that the localizer used: its version, and the cells of its tiles in their order."""

    version: int
    manifest_sha256: str
    cells: tuple[tuple[int, int], ...]


class KeptQuery(msgspec.Struct, array_like=True):
    """A map query: in how many slices its features were extracted, features (N), and the columns of the right image (N,), NaN where
    unknown. The arrays are None of a query that was given up before."""

    slices: int = 0
    pixels: Array | None = None
    octaves: NDArray[np.int8] | None = None
    angles_deg: NDArray[np.float32] | None = None
    descriptors: NDArray[np.uint8] | None = None
    right_px: Array | None = None


class KeptFrame(msgspec.Struct, kw_only=True):
    """What the localizer perceived in one frame, as it is written. used, forgets, priors: what came before it, in this order.

    motions, forgotten: answers of the odometry by frame.
    """

    odometry: OdometryEstimate
    image: ImageQuality
    used: UsedMap | None = None
    forgets: bool = False
    priors: list[PositionPrior] = []
    motions: dict[int, tuple[Array, Array] | None] = {}
    forgotten: dict[int, bool] = {}
    is_reversed: bool = False
    calibration: CalibrationState = NOT_JUDGED
    query: KeptQuery | None = None


@dataclass(slots=True, eq=False)
class Inputs:
    """What came before a frame."""

    used: UsedMap | None = None
    forgets: bool = False
    priors: list[PositionPrior] = field(default_factory=list)
    imu: list[ImuSamples] = field(default_factory=list)
    wheel: list[WheelSample] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class HeldFrame:
    """A frame of the ring. features: of its map query. picture: its images, for a few frames only.

    moment: what the robot said of it; after, used: where a replay of the frames behind it begins, None where it cannot.
    """

    inputs: Inputs
    kept: KeptFrame
    features: FrameFeatures | None = None
    picture: RectifiedFrame | None = None
    moment: Moment = field(init=False)
    after: Start | None = None
    used: UsedMap | None = None

    @property
    def stamp_ns(self) -> int:
        return self.kept.odometry.stamp_ns


@dataclass(slots=True, eq=False)
class FailureCut:
    """The part of the ring around an onset; frames is None until all of it has come. is_wanted: of a failure that was reported.

    start, used: where its replay begins.
    """

    onset_ns: int
    is_wanted: bool = True
    frames: tuple[HeldFrame, ...] | None = None
    start: Start = field(default_factory=Start)
    used: UsedMap | None = None


def moment_of(estimate: Estimate) -> Moment:
    """What the robot says of a frame, for people."""
    said = Moment(estimate.stamp_ns, estimate.status.value, estimate.cause.value)
    map_from_body, covariance = estimate.map_from_body, estimate.cov_rot_trans
    if map_from_body is None:
        return said
    x_m, y_m, z_m = map_from_body[:3, 3].tolist()
    heading_rad = atan2(map_from_body[1, 0], map_from_body[0, 0])
    radius_m = None if covariance is None else radius_95_m(covariance)
    return msgspec.structs.replace(said, position_map_m=(x_m, y_m, z_m), heading_rad=heading_rad, radius_95_m=radius_m)


class FailureRing:
    """The perception of a localizer, followed: each answer is passed on and kept. For the thread that localizes; cuts are for any."""

    def __init__(self, localizer: Localizer) -> None:
        """Puts itself between the localizer and its perception."""
        self._localizer, self._inner = localizer, localizer.perception
        localizer.perception = self
        self.add, self.give_up, self.judged = self._inner.add, self._inner.give_up, self._inner.judged
        self._frames: deque[HeldFrame] = deque()
        self._is_whole = True  # since the robot began
        self._inputs = Inputs()
        self._used: UsedMap | None = None
        self._frame: HeldFrame | None = None
        self._seen: RectifiedFrame | None = None
        self._cuts: list[FailureCut] = []  # that are not complete
        self._held: FailureCut | None = None  # of what goes on and may become a failure
        self._query: HeldFrame | None = None  # the frame of the last one
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
        frame = self._now
        frame.kept.calibration = estimate.calibration._replace(drifts=())
        frame.moment, frame.after, frame.used = moment_of(estimate), self._localizer.start(), self._used
        if self._query is not None and (index := self._query.kept.odometry.frame_index) not in frame.kept.motions:
            # Another version may find a fix in the last query's frame, and go on from there.
            frame.kept.motions[index] = self._inner.motion_since(index)
        self._note_picture(frame)
        self._frames.append(frame)
        now_ns = frame.stamp_ns
        self._follow_onsets(begun_ns)
        for cut in [cut for cut in self._cuts if now_ns >= cut.onset_ns + AFTER_NS]:
            self._complete(cut)
        oldest_ns = now_ns - BEFORE_NS - AFTER_NS - _QUERY_NS
        while len(self._frames) > _MAX_FRAMES or self._frames[0].stamp_ns < oldest_ns:
            self._frames.popleft()
            self._is_whole = False

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
        return self._inner.judge(frame)

    def follow(self, frame: RectifiedFrame, image: ImageQuality) -> tuple[OdometryEstimate, ImageQuality]:
        odometry, image = self._inner.follow(frame, image)
        bare = replace(odometry, track_ids=_NO_TRACKS, track_pixels=None, revised=())
        given, self._inputs = self._inputs, Inputs()
        kept = KeptFrame(odometry=bare, image=image, used=given.used, forgets=given.forgets, priors=given.priors)
        self._frame = HeldFrame(given, kept)
        return odometry, image

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        found = self._now.kept.motions[frame_index] = self._inner.motion_since(frame_index)
        return found

    def will_forget(self, frame_index: int) -> bool:
        found = self._now.kept.forgotten[frame_index] = self._inner.will_forget(frame_index)
        return found

    def is_reversed(self, frame: RectifiedFrame, *, is_localized: bool) -> bool:
        found = self._now.kept.is_reversed = self._inner.is_reversed(frame, is_localized=is_localized)
        return found

    def may_query(self, *, is_due: bool) -> bool:
        return self._inner.may_query(is_due=is_due)

    def extract(self, relocalizer: Relocalizer, frame: RectifiedFrame) -> TimeSliced[FrameFeatures]:
        if self._query is not None and self._query.features is not None:
            self._query.features.frame = None  # nothing more is measured in it
        held = self._query = self._now
        query = held.kept.query = KeptQuery()
        work = self._inner.extract(relocalizer, frame)
        while True:
            try:
                next(work)
            except StopIteration as done:
                held.features = done.value
                return held.features
            query.slices += 1
            yield

    # --- the ring -----------------------------------------------------------------------------------------------------

    @property
    def _now(self) -> HeldFrame:
        assert self._frame is not None
        return self._frame

    def _note_picture(self, frame: HeldFrame) -> None:
        since_ns = frame.stamp_ns - self._pictured_ns
        if since_ns >= (_PICTURES_NS if frame.kept.query is not None else _LATEST_PICTURE_NS):
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
        """Gives a cut its frames; what still changes is copied."""
        self._cuts.remove(cut)
        frames = list(self._frames)
        begins = [number for number, frame in enumerate(frames) if frame.after is not None]
        early = [number for number in begins if frames[number].stamp_ns <= cut.onset_ns - BEFORE_NS]
        begin = early[-1] if early else begins[0] if begins and not self._is_whole else None
        if begin is not None:
            cut.start, cut.used = frames[begin].after or Start(), frames[begin].used
            frames = frames[begin + 1 :]
        for place, frame in enumerate(frames):
            if (found := frame.features) is not None and found.frame is not None:
                tried = None if found.is_tried is None else found.is_tried.copy()
                copied = FrameFeatures(found.features, found.pixels.copy(), None, tried)
                frames[place] = replace(frame, features=copied)
                frames[place].moment = frame.moment
        cut.frames = tuple(frames) or None
