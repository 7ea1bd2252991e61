"""What is wrong with the pictures of a frame, told from them alone. Pure."""

from collections import deque
from dataclasses import dataclass
from math import sqrt
from statistics import median

import numpy as np

from fleetmap.config import Section
from fleetmap.messages import Cause
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import Image
from locclient.localization import image_quality_kernels

_EVERY_PX = 8  # rows and columns that are looked at
_BRIGHT = 250


class ImageQualitySettings(Section, frozen=True):
    """When a picture counts as bad."""

    dark_contrast: float = 4.0
    glare_share: float = 0.6
    blurred_share: float = 0.1
    typical_frames: int = 150
    occluded_depth_share: float = 0.4


class ImageQualityMonitor:
    """Judges frames in their order."""

    def __init__(self, settings: ImageQualitySettings) -> None:
        self._settings = settings
        self._last: list[Image | None] = [None, None]
        self._frozen = [False, False]
        self._sharpness: deque[float] = deque(maxlen=settings.typical_frames)
        self._depths_m: deque[float] = deque(maxlen=settings.typical_frames)

    def judge(self, frame: RectifiedFrame) -> Cause:
        """What is wrong with the pictures of `frame`: too dark, too bright, the last one again (of either camera), or blurred."""
        looks = [_Look.at(picture) for picture in (frame.left, frame.right) if picture is not None]
        self._frozen = [self._is_frozen(side, look) for side, look in enumerate(looks)]
        left = looks[0]
        if left.contrast < self._settings.dark_contrast:
            return Cause.DARK if left.mean < 128.0 else Cause.GLARE
        if left.bright_share > self._settings.glare_share:
            return Cause.GLARE
        if any(self._frozen):
            return Cause.FROZEN
        count, total, squares = image_quality_kernels.row_steps(frame.left, _EVERY_PX)
        sharpness = squares / count - (total / count) ** 2
        typical = median(self._sharpness) if self._sharpness else sharpness
        self._sharpness.append(sharpness)
        return Cause.BLURRED if sharpness < self._settings.blurred_share * typical else Cause.NONE

    def without_frozen(self, frame: RectifiedFrame) -> RectifiedFrame:
        """`frame`, just judged, without what a stuck camera repeats: no right picture, or nothing to see at all."""
        left = np.zeros_like(frame.left) if self._frozen[0] else frame.left
        return RectifiedFrame(frame.stamp_ns, left, None, None)

    def judge_depth(self, scene_depth_m: float) -> Cause:
        """Whether something stands before the cameras: what is seen is much nearer than it used to be."""
        typical_m = median(self._depths_m) if self._depths_m else scene_depth_m
        if scene_depth_m < self._settings.occluded_depth_share * typical_m:
            return Cause.OCCLUDED
        self._depths_m.append(scene_depth_m)
        return Cause.NONE

    def _is_frozen(self, side: int, look: "_Look") -> bool:
        """Sensor noise never repeats itself: equal to the last bit is a stuck camera."""
        last, self._last[side] = self._last[side], look.small
        return last is not None and look.contrast > 1.0 and np.array_equal(last, look.small)


@dataclass(frozen=True, slots=True)
class _Look:
    """A picture thinned out, with mean and standard deviation of what is left, and the share of it that is as good as white."""

    small: Image
    mean: float
    contrast: float
    bright_share: float

    @classmethod
    def at(cls, picture: Image) -> "_Look":
        height, width = picture.shape
        small = np.empty((-(-height // _EVERY_PX), -(-width // _EVERY_PX)), np.uint8)
        total, squares, brights = image_quality_kernels.thin(np.ascontiguousarray(picture), _EVERY_PX, _BRIGHT, small)
        mean = total / small.size
        return cls(small, mean, sqrt(max(squares / small.size - mean * mean, 0.0)), brights / small.size)
