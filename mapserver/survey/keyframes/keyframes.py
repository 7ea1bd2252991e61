"""Keyframe selection, and the data that is kept of each keyframe."""

from collections import deque
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count, islice
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.features import orb, patch_align, stereo
from fleetmap.features.extraction import extract
from fleetmap.geometry import AnyArray, Array, rotation_angle_rad, se3_inverse
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.settings import KeyframeSettings, SurveySettings

_BATCH = 2  # frames for one call: a twentieth of a second each


@dataclass(frozen=True, slots=True)
class Pictures:
    """What a keyframe looks like: its rectified frame and the left picture's pyramid."""

    frame: RectifiedFrame
    pyramid: patch_align.Pyramid


class ImageStore(Protocol):
    """Storage for the pictures of keyframes, and for what is found in them: those of a long survey do not fit in memory. For any thread."""

    def put(self, pictures: Pictures) -> int:
        """The number under which `get` gives them back."""

    def get(self, number: int) -> Pictures:
        """The pictures as they were put."""

    def keep(self, arrays: Sequence[AnyArray]) -> list[AnyArray]:
        """The same arrays, where memory need not hold them all the time."""

    def release(self) -> None:
        """A stage is over: what `keep` returned may leave memory until it is read again."""


class MemoryImageStore:
    """Keeps all pictures as they are."""

    def __init__(self) -> None:
        self._numbers = count()
        self._pictures: dict[int, Pictures] = {}

    def put(self, pictures: Pictures) -> int:
        number = next(self._numbers)
        self._pictures[number] = pictures
        return number

    def get(self, number: int) -> Pictures:
        return self._pictures[number]

    def keep(self, arrays: Sequence[AnyArray]) -> list[AnyArray]:
        return list(arrays)

    def release(self) -> None:
        """See ImageStore."""


@dataclass(frozen=True, slots=True)
class Keyframe:
    """One keyframe: features (N), disparities (N, 2) with sigma, their points; its pictures are in an image store.

    from_views: the disparities come from other keyframes, so they place points but measure nothing of their own. nodes (N, 2): the
    vocabulary's branches that are nearest to each feature; None where all descriptors are compared.
    """

    frame_index: int
    stamp_ns: int
    features: orb.Features
    disparities: Array
    points_cam: Array
    images: ImageStore
    image_number: int
    from_views: bool = False
    nodes: NDArray[np.int32] | None = None

    @property
    def pictures(self) -> Pictures:
        """The pictures, fetched from the image store."""
        return self.images.get(self.image_number)

    @property
    def frame(self) -> RectifiedFrame:
        """The rectified frame."""
        return self.pictures.frame

    @property
    def pyramid(self) -> patch_align.Pyramid:
        """The left picture and its halvings."""
        return self.pictures.pyramid


@dataclass(frozen=True, slots=True)
class PosedKeyframes:
    """K keyframes at map_from_body (K, 4, 4), seen by one camera with the mounting body_from_cam (4, 4)."""

    keyframes: list[Keyframe]
    map_from_body: Array
    body_from_cam: Array
    camera: StereoCamera

    @property
    def map_from_cam(self) -> Array:
        """(K, 4, 4)."""
        return self.map_from_body @ self.body_from_cam


def make_keyframe(frame: RectifiedFrame, frame_index: int, camera: StereoCamera, settings: SurveySettings) -> Keyframe:
    """Detects, describes and stereo-matches one frame; its pictures stay in memory."""
    return next(make_keyframes([(frame_index, frame)], camera, settings))


def make_keyframes(
    frames: Iterable[tuple[int, RectifiedFrame]],
    camera: StereoCamera,
    settings: SurveySettings,
    images: ImageStore | None = None,
    executor: Executor = SERIAL,
) -> Iterator[Keyframe]:
    """Keyframes of numbered frames; the executor extracts features while the next frames are awaited.

    images: takes the pictures, memory without one.
    """
    kept = MemoryImageStore() if images is None else images
    waiting: deque[tuple[int, RectifiedFrame]] = deque()

    def batches() -> Iterator[list[RectifiedFrame]]:
        source = iter(frames)
        while batch := list(islice(source, _BATCH)):
            waiting.extend(batch)
            yield [frame for _, frame in batch]

    for found in executor.map(_extract, (camera, settings), batches()):
        for features, disparities in found:
            number, frame = waiting.popleft()
            points = camera.point_from_pixel(features.pixels, disparities[:, 0])
            place = kept.put(Pictures(frame, patch_align.half_pyramid(frame.left)))
            yield set_aside(Keyframe(number, frame.stamp_ns, features, disparities, points, kept, place), kept)


def _extract(
    shared: tuple[StereoCamera, SurveySettings], frames: list[RectifiedFrame]
) -> list[tuple[orb.Features, Array]]:
    """What is found in some frames: features and disparities."""
    camera, settings = shared
    found = []
    for frame in frames:
        features = extract(frame.left, settings.orb)
        found.append((features, stereo.disparities(frame, camera, features.pixels, settings.stereo)))
    return found


def set_aside(keyframe: Keyframe, store: ImageStore) -> Keyframe:
    """The same keyframe with its features where `store` keeps them."""
    own = keyframe.features
    found = own.pixels, own.octaves, own.angles_deg, own.descriptors, keyframe.disparities, keyframe.points_cam
    *features, disparities, points_cam = store.keep(found)
    return replace(keyframe, features=orb.Features(*features), disparities=disparities, points_cam=points_cam)


def with_pictures(keyframe: Keyframe, *, whole: bool) -> Keyframe:
    """The same keyframe with its pictures in memory; unless `whole`, only the left one's pyramid."""
    pictures, images = keyframe.pictures, MemoryImageStore()
    if not whole:
        frame = RectifiedFrame(keyframe.stamp_ns, pictures.pyramid[0], None, None)
        pictures = Pictures(frame, pictures.pyramid)
    return replace(keyframe, images=images, image_number=images.put(pictures))


def without_pictures(keyframe: Keyframe) -> Keyframe:
    """The same keyframe with an empty image store, cheap to send where only features are compared."""
    return replace(keyframe, images=MemoryImageStore(), image_number=0)


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """Input of the keyframe policy: odometry of one frame, its tracked points, its sharpness."""

    stamp_ns: int
    odom_from_body: Array
    track_ids: NDArray[np.int64]
    scene_depth_m: float
    sharpness: float
    after_gap: bool


class KeyframePolicy:
    """Chooses by overlap with the last keyframe, by motion, or by count; never a blurred frame unless tracking would break."""

    def __init__(self, settings: KeyframeSettings, required: Container[int] = ()) -> None:
        """required: numbers of frames, counted from 0, that are chosen whatever they show."""
        self._settings, self._required = settings, required
        self._last: FrameSummary | None = None
        self._sharpness: deque[float] = deque(maxlen=31)
        self._count = -1

    def wants(self, frame: FrameSummary) -> bool:
        """Whether this frame becomes a keyframe; frames must come in order."""
        self._count += 1
        self._sharpness.append(frame.sharpness)
        chosen = self._chooses(frame)
        if chosen:
            self._last = frame
        return chosen

    def _chooses(self, frame: FrameSummary) -> bool:
        s, last = self._settings, self._last
        if last is None or frame.after_gap or self._count in self._required or s.policy == "every":
            return True
        if s.policy == "every-nth":
            return self._count % s.every_nth == 0
        overlap = len(np.intersect1d(frame.track_ids, last.track_ids)) / max(len(last.track_ids), 1)
        if overlap < s.break_overlap:
            return True
        if frame.sharpness < s.min_sharpness * float(np.median(self._sharpness)):
            return False
        moved = se3_inverse(last.odom_from_body) @ frame.odom_from_body
        return bool(
            overlap < s.min_overlap
            or np.degrees(rotation_angle_rad(moved[:3, :3])) > s.max_rotation_deg
            or np.linalg.norm(moved[:3, 3]) > s.max_parallax * frame.scene_depth_m
            or (frame.stamp_ns - last.stamp_ns) * 1e-9 > s.max_interval_s
        )


def sharpness(frame: RectifiedFrame) -> float:
    """Variance of the Laplacian at half size: falls with motion blur. Source: Pech-Pacheco et al. 2000."""
    return float(cv2.Laplacian(frame.half_left, cv2.CV_32F).var())
