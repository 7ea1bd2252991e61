"""From the messages of a robot's ROS 2 to frames of its rig and samples of its other sensors; without ROS itself."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.recordings import StoredFrame, Topics
from fleetmap.recordings.images import StoredImage, grey_bits, grey_image, grey_peak, is_wide
from fleetmap.recordings.ordering import PAIR_TOLERANCE_NS
from fleetmap.recordings.ros2 import messages
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import UNSAID_SIGMAS, ImuSamples, PositionPrior
from fleetmap.sensors.source_settings import CAMERA_ROLES, DEPTH_ROLES, transports
from fleetmap.sources.intake import Intake

_RECENT = 8  # frames of a view, of which one may be added to another view's
# Images of a side that wait for their partner: a second of them. Over Fast DDS one of two large images was seen to come 0.3 s late.
_UNPAIRED = 30
_DEAD_NS, _NEVER_NS = 500_000_000, -(2**63)
Take = Callable[[Intake, bool, bytes], None]


def _nearest(frames: Iterable[StoredFrame], stamp_ns: int, within_ns: int) -> StoredFrame | None:
    near = [frame for frame in frames if abs(frame.stamp_ns - stamp_ns) <= within_ns]
    return min(near, key=lambda frame: abs(frame.stamp_ns - stamp_ns), default=None)


class _View:
    """A view of a rig: images that wait for their partner of the same moment, and its last frames."""

    def __init__(self, numbers: tuple[int, ...], has_depth: bool) -> None:
        self.numbers, self.recent = numbers, deque[StoredFrame](maxlen=_RECENT)
        self.used_ns = _NEVER_NS  # last stamp in a frame of the rig
        self.silent_since_ns: int | None = None  # first stamp since the first view's last frame
        self._has_depth, self._is_paired = has_depth, has_depth or len(numbers) > 1
        self._unpaired = tuple(deque[StoredFrame](maxlen=_UNPAIRED) for _ in range(2))  # of either side

    def add(self, side: int, stamp_ns: int, image: StoredImage) -> StoredFrame | None:
        """Add an image; return the frame that it completes, None while its partner is missing. side: 1 for a right image or depth.

        RecordingError if those of both sides find none.
        """
        frame = StoredFrame(stamp_ns, image)
        if self._is_paired:
            own, others = self._unpaired[side], self._unpaired[1 - side]
            partner = _nearest(others, stamp_ns, PAIR_TOLERANCE_NS)
            if partner is None:
                own.append(frame)
                if others and len(own) == own.maxlen:  # both sides send
                    reason = f"has no partner within {PAIR_TOLERANCE_NS * 1e-6:g} ms: are both triggered together?"
                    raise RecordingError(f"an image at {stamp_ns} {reason}")
                return None
            for items in self._unpaired:
                while items and items[0].stamp_ns <= max(partner.stamp_ns, stamp_ns):
                    items.popleft()
            frame, second = (partner, image) if side else (frame, partner.left)
            frame = replace(frame, depth=second) if self._has_depth else replace(frame, right=second)
        if self.recent and frame.stamp_ns <= self.recent[-1].stamp_ns:  # its clock was set
            self.recent.clear()
            self.used_ns = _NEVER_NS
        self.recent.append(frame)
        return frame

    @property
    def period_ns(self) -> int | None:
        steps_ns = sorted(later.stamp_ns - earlier.stamp_ns for earlier, later in pairwise(self.recent))
        return steps_ns[len(steps_ns) // 2] if steps_ns else None

    def take_near(self, stamp_ns: int, within_ns: int) -> StoredFrame | None:
        """Return the unused frame nearest to a stamp, None if there is none within."""
        near = _nearest([frame for frame in self.recent if frame.stamp_ns > self.used_ns], stamp_ns, within_ns)
        self.used_ns = self.used_ns if near is None else near.stamp_ns
        return near


class RigFrames:
    """Adds to each frame of a rig's first view the images of the other views that are nearest to it, at most half a period away.

    A frame waits for the views that still send, at most until the next one. While the first view sends nothing for half a second of another
    view's stamps, that view leads: frames have its stamps and are black in the first view, so that the others carry on.
    """

    def __init__(self, calibration: RigCalibration, *, has_depth: bool = False) -> None:
        """has_depth: whether the first view is a camera with depth."""
        has_depths = [has_depth, *(calibration.cameras[view[0]].has_depth for view in calibration.views[1:])]
        self._views = [_View(*view) for view in zip(calibration.views, has_depths, strict=True)]
        self._leader = self._views[0]
        self._waiting: StoredFrame | None = None
        first = calibration.cameras[0]
        self._black = grey_image(np.zeros((first.height_px, first.width_px), np.uint8))

    def add(self, number: int, stamp_ns: int, image: StoredImage, *, is_depth: bool = False) -> list[StoredFrame]:
        """Add an image of a camera, or its depth; return the frames that are complete. RecordingError for one without a partner."""
        view = next(view for view in self._views if number in view.numbers)
        frame = view.add(int(is_depth or number != view.numbers[0]), stamp_ns, image)
        done = list[StoredFrame]()
        if frame is None:
            return done
        if self._leads(view, frame.stamp_ns):
            done = [] if self._waiting is None else [self._with_others(self._waiting)]
            self._waiting = frame if view is self._views[0] else StoredFrame(frame.stamp_ns, self._black)
        if self._waiting is not None and not any(self._is_expected(view, self._waiting) for view in self._views[1:]):
            done.append(self._with_others(self._waiting))
            self._waiting = None
        return done

    def _leads(self, view: _View, stamp_ns: int) -> bool:
        """True if frames have the stamps of this view, the first one or one that stands in for it."""
        first, *others = self._views
        if view is first:
            self._leader = first
            for other in others:
                other.silent_since_ns = None
            return True
        if view.silent_since_ns is None:
            view.silent_since_ns = stamp_ns
        is_alone = self._leader is first or abs(stamp_ns - self._leader.recent[-1].stamp_ns) > _DEAD_NS
        if is_alone and stamp_ns - view.silent_since_ns > _DEAD_NS:
            self._leader = view
        return view is self._leader

    def _is_expected(self, view: _View, waiting: StoredFrame) -> bool:
        """True if the next image of a view that still sends belongs to the waiting frame, by the rate of that view."""
        if not view.recent or view.recent[-1].stamp_ns >= waiting.stamp_ns:
            return False
        leader_ns = self._leader.period_ns or _DEAD_NS
        own_ns = view.period_ns or leader_ns
        return own_ns - leader_ns // 2 <= waiting.stamp_ns - view.recent[-1].stamp_ns < 1.5 * own_ns

    def _with_others(self, frame: StoredFrame) -> StoredFrame:
        _, *others = self._views
        if not others:
            return frame
        within_ns = (self._leader.period_ns or _DEAD_NS) // 2
        return replace(frame, others=tuple(view.take_near(frame.stamp_ns, within_ns) for view in others))


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
        self.calibration, self.has_depth = calibration, has_depth
        self._grey_peak = 0  # used bits of 16-bit images, until one has more than 12
        takes: dict[str, Take] = {
            "wheel": lambda intake, _, data: intake.put_wheel(messages.decode_odometry(data)),
            "prior": lambda intake, _, data: intake.put_prior(_decode_prior(data, ("", map_frame))),
        }
        if calibration.imu is not None:
            takes["imu"] = lambda intake, _, data: intake.put_imu(ImuSamples(*messages.decode_imu([data])[:3]))
        self.topics: list[tuple[tuple[str, ...], str, Take]]
        self.topics = [((getattr(topics, kind),), kind, take) for kind, take in takes.items()]
        if images:
            cameras = calibration.cameras[:1] if has_depth else calibration.cameras
            self._rig = RigFrames(replace(calibration, cameras=cameras), has_depth=has_depth)
            for number, camera in enumerate(cameras):
                depths = DEPTH_ROLES[max(number - 1, 0) :][: has_depth or (number > 1 and camera.has_depth)]
                for role in (*CAMERA_ROLES[number : number + 1], *depths):
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


def _decode_prior(data: bytes, frames: Sequence[str]) -> PositionPrior:
    _, frame_id = messages.header_of(data)
    if frame_id.lstrip("/") not in frames:
        raise RecordingError(f"a pose in the frame {frame_id!r} is not used; give it in {frames[-1]!r}")
    try:
        return messages.decode_prior(data)
    except ValueError as error:
        raise RecordingError(f"a pose is not used: {error}; give a finite position and a unit quaternion") from error


def decode_initial_pose(data: bytes, map_frame: str) -> PositionPrior:
    """geometry_msgs/PoseWithCovarianceStamped of an operator: a prior from now on, independent of its stamp.

    RecordingError for another frame, a pose or covariance that is not finite, and an invalid covariance.
    """
    prior, fault = _decode_prior(data, (map_frame,)), ""
    cov = prior.cov_rot_trans
    if not np.isfinite(cov).all():
        fault = "holds NaN or infinity; give variances, or zeros"
    elif not np.allclose(cov, cov.T, atol=1e-6) or np.linalg.eigvalsh((cov + cov.T) / 2)[0] < -1e-6:
        fault = "is not symmetric and positive; check its order"
    if fault:
        raise RecordingError(f"an initial pose is not used: its covariance {fault}")
    said = np.diag(cov) > 0
    cov = np.where(np.outer(said, said), (cov + cov.T) / 2, 0.0) + np.diag(np.where(said, 0.0, UNSAID_SIGMAS**2))
    return PositionPrior(0, prior.map_from_base, cov, is_revisable=True)
