"""From the messages of a robot's ROS 2 to frames of its rig and samples of its other sensors; without ROS itself."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.recordings import StoredFrame, Topics
from fleetmap.recordings.images import StoredImage, grey_bits, grey_image, grey_peak, is_wide
from fleetmap.recordings.ordering import PAIR_TOLERANCE_NS
from fleetmap.recordings.ros2 import messages
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import ImuSamples
from fleetmap.sensors.source_settings import CAMERA_ROLES, DEPTH_ROLES, transports
from fleetmap.sources.intake import Intake

_WAITING_IMAGES = 8  # images of each side waiting for their partner
_DEAD_NS = 500_000_000
Take = Callable[[Intake, bool, bytes], None]


class StereoPairs:
    """Pairs the images of two streams whose stamps are within the tolerance of one rig; images without a partner are counted."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[tuple[int, StoredImage]]] = {"left": deque(), "right": deque()}
        self.unpaired = 0

    def add(self, side: str, stamp_ns: int, image: StoredImage) -> StoredFrame | None:
        """Add an image; return the frame that it completes, None while its partner is missing. side: left or right."""
        others = self._waiting["right" if side == "left" else "left"]
        partner = min(others, key=lambda item: abs(item[0] - stamp_ns), default=None)
        if partner is None or abs(partner[0] - stamp_ns) > PAIR_TOLERANCE_NS:
            own = self._waiting[side]
            own.append((stamp_ns, image))
            if len(own) > _WAITING_IMAGES:
                own.popleft()
                self.unpaired += 1
            return None
        for items in self._waiting.values():
            while items and items[0][0] <= max(partner[0], stamp_ns):
                if items.popleft() is not partner:
                    self.unpaired += 1
        left, right = (image, partner[1]) if side == "left" else (partner[1], image)
        return StoredFrame(stamp_ns if side == "left" else partner[0], left, right)


class RigFrames:
    """Adds to each frame of a rig's first view the images of the other views that are nearest to it, at most half a period away.

    A frame waits for the views that still send, at most until the next one. While the first view sends nothing for half a second of another
    view's stamps, that view leads: frames have its stamps and are black in the first view, so that the others carry on.
    """

    def __init__(self, calibration: RigCalibration, *, has_depth: bool = False) -> None:
        """has_depth: whether the first view is a camera with depth."""
        self._views = calibration.views
        self._has_depth = [has_depth, *(calibration.cameras[view[0]].has_depth for view in self._views[1:])]
        self._pairs = [
            StereoPairs() if len(view) > 1 or has_depth else None
            for view, has_depth in zip(self._views, self._has_depth, strict=True)
        ]
        self._recent = [deque[StoredFrame](maxlen=_WAITING_IMAGES) for _ in self._views]  # of each view
        self._waiting: StoredFrame | None = None
        self._leader = 0
        self._silent_since_ns = dict[int, int]()  # first stamps of other views since the first view's last frame
        self._used_ns = dict[int, int]()  # last stamps in a frame, of other views
        first = calibration.cameras[0]
        self._black = grey_image(np.zeros((first.height_px, first.width_px), np.uint8))

    @property
    def unpaired(self) -> int:
        return sum(pairs.unpaired for pairs in self._pairs if pairs is not None)

    def add(self, number: int, stamp_ns: int, image: StoredImage, *, is_depth: bool = False) -> list[StoredFrame]:
        """Add an image of a camera, or its depth; return the frames that are complete."""
        view = next(k for k, numbers in enumerate(self._views) if number in numbers)
        pairs, side = self._pairs[view], "left" if number == self._views[view][0] and not is_depth else "right"
        frame = StoredFrame(stamp_ns, image) if pairs is None else pairs.add(side, stamp_ns, image)
        if frame is None:
            return []
        if self._has_depth[view]:
            frame = replace(frame, right=None, depth=frame.right)
        recent = self._recent[view]
        if recent and frame.stamp_ns <= recent[-1].stamp_ns:  # its clock was set
            recent.clear()
            self._used_ns.pop(view, None)
        recent.append(frame)
        done = list[StoredFrame]()
        if self._leads(view, frame.stamp_ns):
            done += [] if self._waiting is None else [self._with_others(self._waiting)]
            self._waiting = frame if view == 0 else StoredFrame(frame.stamp_ns, self._black)
        if self._waiting is not None and not any(map(self._is_expected, self._recent[1:])):
            done.append(self._with_others(self._waiting))
            self._waiting = None
        return done

    def _leads(self, view: int, stamp_ns: int) -> bool:
        """True if frames have the stamps of this view, the first one or one that stands in for it."""
        if view == 0:
            self._leader = 0
            self._silent_since_ns.clear()
        elif stamp_ns - self._silent_since_ns.setdefault(view, stamp_ns) > _DEAD_NS and (
            self._leader == 0 or abs(stamp_ns - self._recent[self._leader][-1].stamp_ns) > _DEAD_NS
        ):
            self._leader = view
        return view == self._leader

    def _is_expected(self, recent: deque[StoredFrame]) -> bool:
        """True if the next image of a view that still sends belongs to the waiting frame, by the rate of that view."""
        assert self._waiting is not None
        if not recent or recent[-1].stamp_ns >= self._waiting.stamp_ns:
            return False
        leader_ns = self._period_ns()
        own_ns, since_ns = _period_ns(recent) or leader_ns, self._waiting.stamp_ns - recent[-1].stamp_ns
        return own_ns - leader_ns // 2 <= since_ns < 1.5 * own_ns

    def _period_ns(self) -> int:
        return _period_ns(self._recent[self._leader]) or _DEAD_NS

    def _with_others(self, frame: StoredFrame) -> StoredFrame:
        others = list[StoredFrame | None]()
        for view, recent in enumerate(list(self._recent)[1:], start=1):
            unused = [other for other in recent if other.stamp_ns > self._used_ns.get(view, other.stamp_ns - 1)]
            near = min(unused, key=lambda other: abs(other.stamp_ns - frame.stamp_ns), default=None)
            if near is not None and abs(near.stamp_ns - frame.stamp_ns) > self._period_ns() // 2:
                near = None
            if near is not None:
                self._used_ns[view] = near.stamp_ns
            others.append(near)
        return replace(frame, others=tuple(others)) if others else frame


def _period_ns(recent: deque[StoredFrame]) -> int | None:
    stamps = [frame.stamp_ns for frame in recent]
    return int(np.median(np.diff(stamps))) if len(stamps) > 1 else None


class SensorMessages:
    """What is taken of a robot's sensors: topics, of which one is used, kind (image, imu, wheel or prior), and what takes a message."""

    def __init__(
        self,
        topics: Topics,
        calibration: RigCalibration,
        *,
        images: bool = True,
        has_depth: bool = False,
        map_frame: str = "map",
    ) -> None:
        """images: False takes everything but images, which come from another source. has_depth: depth images instead of right ones.

        A calibration of one camera takes only left images. map_frame: the frame of priors; those in another frame are refused.
        """
        self._grey_peak = 0  # used bits of 16-bit images, until one has more than 12
        self.topics: list[tuple[tuple[str, ...], str, Take]] = [
            ((topics.wheel,), "wheel", _take_wheel),
            ((topics.prior,), "prior", partial(_take_prior, map_frame)),
        ]
        if calibration.imu is not None:
            self.topics.append(((topics.imu,), "imu", _take_imu))
        if images:
            cameras = calibration.cameras[:1] if has_depth else calibration.cameras
            self._rig = RigFrames(replace(calibration, cameras=cameras), has_depth=has_depth)
            roles = [*enumerate(CAMERA_ROLES[: len(cameras)]), *([(0, DEPTH_ROLES[0])] if has_depth else [])]
            depths = zip(range(2, len(cameras)), DEPTH_ROLES[1:], strict=False)
            roles += [(number, role) for number, role in depths if cameras[number].has_depth]
            for number, role in roles:
                names = transports(getattr(topics, role), role)
                self.topics.append((names, "image", partial(self._take_image, number, role)))

    def _take_image(self, number: int, role: str, intake: Intake, is_compressed: bool, payload: bytes) -> None:
        stamp_ns, _ = messages.header_of(payload)
        decode = messages.decode_compressed_image if is_compressed else messages.decode_image
        image, is_depth = decode(payload, f"{role} at {stamp_ns}"), role in DEPTH_ROLES
        if is_wide(image) and not is_depth:
            self._grey_peak = max(self._grey_peak, grey_peak(image) if self._grey_peak < 1 << 12 else 0)
            image = replace(image, bits=grey_bits(self._grey_peak))
        for frame in self._rig.add(number, stamp_ns, image, is_depth=is_depth):
            intake.put_frame(frame)


def _take_imu(intake: Intake, _is_compressed: bool, payload: bytes) -> None:
    stamps_ns, gyro_radps, accel_mps2, _ = messages.decode_imu([payload])
    intake.put_imu(ImuSamples(stamps_ns, gyro_radps, accel_mps2))


def _take_wheel(intake: Intake, _is_compressed: bool, payload: bytes) -> None:
    intake.put_wheel(messages.decode_odometry(payload))


def _take_prior(map_frame: str, intake: Intake, _is_compressed: bool, payload: bytes) -> None:
    _, frame_id = messages.header_of(payload)
    if frame_id.lstrip("/") not in ("", map_frame):
        raise RecordingError(f"a position prior in the frame {frame_id!r} is not used; give it in {map_frame!r}")
    intake.put_prior(messages.decode_prior(payload))
