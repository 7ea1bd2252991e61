"""Ring buffer of the last seconds: percepts, results and a few pictures, for the replay of a failure. Pure.

The odometry does not depend on the map: its estimates are stored, not only its samples, so that a replay in the map needs no images.
It starts with the robot's pose at that time.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import atan2

import msgspec
import numpy as np

from fleetmap.failure_definition import known_radius_m
from fleetmap.failure_summary import Moment
from fleetmap.messages import FailureKind
from fleetmap.relocalization.relocalizer import FrameFeatures
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, PositionPrior, WheelSample
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.localization.estimate import Estimate
from locclient.localization.perception import Percept, QueryInput
from locclient.localization.pose_tracker import Start
from locclient.maps.loaded_map import LoadedMap

BEFORE_NS, AFTER_NS = 5_000_000_000, 5_000_000_000  # of a failure's onset
_QUERY_NS = 2_000_000_000  # longer than a map query: a replay begins between two of them
_PICTURES_NS, _LATEST_PICTURE_NS = 450_000_000, 900_000_000  # between two pictures: of map queries, of any frames
_SAME_ONSET_NS = 3_500_000_000  # a carried robot's onset is the loss of its tracks, up to three seconds earlier
_MAX_FRAMES = 1000  # 90 a second: a camera that is faster has a shorter ring
_NO_TRACKS = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True)
class UsedMap:
    """Map of the localizer: its version, and the cells of its tiles in order. floor: as of `Estimate`, the site whose map it is."""

    version: int
    manifest_sha256: str
    cells: tuple[tuple[int, int], ...]
    floor: str = ""


@dataclass(slots=True, eq=False)
class Commands:
    """Commands before a frame, in this order."""

    used: UsedMap | None = None
    forgets: bool = False
    priors: list[PositionPrior] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class RingFrame:
    """A frame of the ring. imu, wheel: since the previous frame. picture: its images, for a few frames only. moment: result.

    after, used: start state and map of a replay of the following frames; None if it cannot start here.
    """

    commands: Commands
    imu: list[ImuSamples]
    wheel: list[WheelSample]
    percept: Percept
    moment: Moment
    after: Start | None
    used: UsedMap | None
    picture: RectifiedFrame | None = None

    @property
    def stamp_ns(self) -> int:
        return self.percept.odometry.stamp_ns


@dataclass(slots=True, eq=False)
class FailureCut:
    """Part of the ring around an onset; frames is None until complete. is_wanted: of a reported failure.

    start, used: start state and map of its replay.
    """

    onset_ns: int
    is_wanted: bool = True
    frames: tuple[RingFrame, ...] | None = None
    start: Start = field(default_factory=Start)
    used: UsedMap | None = None


def moment_of(estimate: Estimate) -> Moment:
    """Return the result of a frame in a form for display."""
    said = Moment(estimate.stamp_ns, estimate.status.value, estimate.cause.value)
    map_from_body, covariance = estimate.map_from_body, estimate.cov_rot_trans
    if map_from_body is None:
        return said
    x_m, y_m, z_m = map_from_body[:3, 3].tolist()
    heading_rad = atan2(map_from_body[1, 0], map_from_body[0, 0])
    radius_m = known_radius_m(covariance)
    return msgspec.structs.replace(said, position_map_m=(x_m, y_m, z_m), heading_rad=heading_rad, radius_95_m=radius_m)


class FailureRing:
    """Frames of the last seconds, and cuts from them. For the localizing thread; cuts are for any thread."""

    def __init__(self) -> None:
        self._frames: deque[RingFrame] = deque()
        self._is_whole = True  # since the robot began
        self._commands, self._imu, self._wheel = Commands(), list[ImuSamples](), list[WheelSample]()
        self._used: UsedMap | None = None
        self._cuts: list[FailureCut] = []  # incomplete ones
        self._held: FailureCut | None = None  # of an ongoing condition that may become a failure
        self._query: QueryInput | None = None  # of the last map query
        self._pictured_ns = -(2**62)

    def use(self, loaded: LoadedMap, site: str = "") -> None:
        used = UsedMap(loaded.version, loaded.wanted.manifest_sha256 or "", tuple(loaded.tiles), site)
        self._used = self._commands.used = used

    def handle_samples(self, bundle: SensorBundle) -> None:
        """Add the samples of a bundle before its frame."""
        self._imu.append(bundle.imu)
        self._wheel.extend(bundle.wheel)
        self._commands.forgets |= bundle.forget
        if bundle.forget:
            self._commands.priors.clear()
        self._commands.priors.extend(bundle.priors)

    def handle_prior(self, prior: PositionPrior) -> None:
        """Add a prior by the images of the next frame."""
        self._commands.priors.append(prior)

    def handle(
        self,
        percept: Percept,
        frame: RectifiedFrame,
        estimate: Estimate,
        start: Start | None,
        begun_ns: Mapping[FailureKind, int],
    ) -> None:
        """Finish a frame. start: state for a replay from the next frame. begun_ns: start of possible failures, by kind."""
        if percept.query is not None:
            if self._query is not None and self._query.features is not None:
                self._query.features.frame = None  # nothing more is measured in it
            self._query = percept.query
        bare = replace(percept.odometry, track_ids=_NO_TRACKS, track_pixels=None, revised=())
        percept = replace(percept, odometry=bare, calibration=percept.calibration._replace(drifts=()))
        now_ns = percept.odometry.stamp_ns
        samples = self._commands, self._imu, self._wheel
        kept = RingFrame(*samples, percept, moment_of(estimate), start, self._used)
        self._commands, self._imu, self._wheel = Commands(), [], []
        if now_ns - self._pictured_ns >= (_PICTURES_NS if percept.query is not None else _LATEST_PICTURE_NS):
            self._pictured_ns, kept.picture = now_ns, frame
        self._frames.append(kept)
        if self._held is not None and self._held.onset_ns not in begun_ns.values():
            if self._held in self._cuts and not self._held.is_wanted:
                self._cuts.remove(self._held)
            self._held = None
        if self._held is None and begun_ns:
            self._held = FailureCut(min(begun_ns.values()), is_wanted=False)
            self._cuts.append(self._held)
        for cut in [cut for cut in self._cuts if now_ns >= cut.onset_ns + AFTER_NS]:
            self._complete(cut)
        oldest_ns = now_ns - BEFORE_NS - AFTER_NS - _QUERY_NS
        while len(self._frames) > _MAX_FRAMES or self._frames[0].stamp_ns < oldest_ns:
            self._frames.popleft()
            self._is_whole = False

    def cut(self, onset_ns: int) -> FailureCut:
        """Return the cut around the onset of a failure, with frames still to come."""
        held = self._held
        if held is not None and abs(held.onset_ns - onset_ns) <= _SAME_ONSET_NS:
            held.is_wanted = True
            return held
        cut = FailureCut(onset_ns)
        self._cuts.append(cut)
        return cut

    def finish(self) -> None:
        """Complete waiting cuts: no frame follows."""
        for cut in list(self._cuts):
            self._complete(cut)

    def _complete(self, cut: FailureCut) -> None:
        """Set the frames of a cut; copy data that still change."""
        self._cuts.remove(cut)
        frames = list(self._frames)
        begins = [number for number, frame in enumerate(frames) if frame.after is not None]
        early = [number for number in begins if frames[number].stamp_ns <= cut.onset_ns - BEFORE_NS]
        begin = early[-1] if early else begins[0] if begins and not self._is_whole else None
        if begin is not None:
            cut.start, cut.used = frames[begin].after or Start(), frames[begin].used
            frames = frames[begin + 1 :]
        for place, frame in enumerate(frames):
            query = frame.percept.query
            if query is not None and query.features is not None and query.features.frame is not None:
                found = query.features
                tried = None if found.is_tried is None else found.is_tried.copy()
                copied = replace(query, features=FrameFeatures(found.features, found.pixels.copy(), None, tried))
                frames[place] = replace(frame, percept=replace(frame.percept, query=copied))
        cut.frames = tuple(frames) or None
