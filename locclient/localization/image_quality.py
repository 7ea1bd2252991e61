"""Image quality of a frame: exposure, sharpness, and faults. Pure."""

from collections import deque
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from fleetmap import core
from fleetmap.config import Section
from fleetmap.messages import Cause
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import CameraFrame

_EVERY_PX = 8  # step of the rows and columns that are sampled
_BRIGHT = 250
UNUSABLE = frozenset({Cause.DARK, Cause.GLARE, Cause.FROZEN, Cause.NO_FRAMES})  # images in which nothing can be found


class ImageQualitySettings(Section, frozen=True):
    """Limits of a good image."""

    dark_contrast: float = 4.0
    glare_share: float = 0.6
    blurred_share: float = 0.1
    typical_frames: int = 150  # for the average contrast and depth
    occluded_depth_share: float = 0.4


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """Quality of one frame's images.

    cause: their fault, NONE for good ones. Of the left image: exposure, the mean brightness from 0 to 1, and sharpness, the variance of
    differences between neighbouring pixels of a row, relative to this robot's typical value.
    """

    cause: Cause = Cause.NONE
    exposure: float = 0.5
    sharpness: float = 1.0


GOOD_IMAGE = ImageQuality()


class ImageQualityMonitor:
    """Assesses frames in order, for the localizer and the failure monitor."""

    def __init__(self, settings: ImageQualitySettings) -> None:
        self._settings = settings
        self._last = [b"", b""]
        self._frozen = [False, False]
        self._sharpness: deque[float] = deque(maxlen=settings.typical_frames)
        self._depths_m: deque[float] = deque(maxlen=settings.typical_frames)

    def judge(self, frame: RectifiedFrame | CameraFrame) -> ImageQuality:
        """Return the quality of `frame`; faults are darkness, glare, a repeated image of either camera, and blur."""
        images = [np.ascontiguousarray(image) for image in (frame.left, frame.right) if image is not None]
        thinned = [core.brightness(image, _EVERY_PX, _BRIGHT) for image in images]
        # An image that is bit-identical to the last one: sensor noise never repeats.
        pixels = [image[0] for image in thinned]
        pairs = zip(thinned, self._last, strict=False)
        self._frozen = [contrast > 1.0 and own == last for (own, _, contrast, *_), last in pairs]
        self._last[: len(pixels)] = pixels
        _, mean, contrast, bright_share, variance = thinned[0]
        settings = self._settings
        typical = median(self._sharpness) if self._sharpness else variance
        if contrast < settings.dark_contrast:
            cause = Cause.DARK if mean < 128.0 else Cause.GLARE
        elif bright_share > settings.glare_share:
            cause = Cause.GLARE
        elif any(self._frozen):
            cause = Cause.FROZEN
        else:
            self._sharpness.append(variance)
            cause = Cause.BLURRED if variance < settings.blurred_share * typical else Cause.NONE
        return ImageQuality(cause, mean / 255.0, variance / max(typical, 1e-9))

    def without_frozen(self, frame: RectifiedFrame) -> RectifiedFrame:
        """Return `frame`, just judged, without images of a stuck camera: no right image, or an empty left one."""
        left = np.zeros_like(frame.left) if self._frozen[0] else frame.left
        return replace(frame, left=left, right=None, disparity_px=None)

    def judge_depth(self, scene_depth_m: float) -> Cause:
        """Return OCCLUDED if the scene is much nearer than usual: an object is in front of the cameras."""
        typical_m = median(self._depths_m) if self._depths_m else scene_depth_m
        if scene_depth_m < self._settings.occluded_depth_share * typical_m:
            return Cause.OCCLUDED
        self._depths_m.append(scene_depth_m)
        return Cause.NONE
