"""Which frames become keyframes, and what is kept of each."""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.features import orb, patch_align, stereo
from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse
from fleetmap.rectification import RectifiedFrame, StereoCamera
from mapserver.survey.settings import KeyframeSettings, SurveySettings


@dataclass(frozen=True, slots=True)
class Keyframe:
    """One keyframe: its rectified frame, features (N), disparities (N, 2) with sigma, and image pyramid."""

    frame_index: int
    frame: RectifiedFrame
    features: orb.Features
    disparities: Array
    points_cam: Array
    pyramid: patch_align.Pyramid

    @property
    def stamp_ns(self) -> int:
        """Sensor time."""
        return self.frame.stamp_ns


def make_keyframe(frame: RectifiedFrame, frame_index: int, camera: StereoCamera, settings: SurveySettings) -> Keyframe:
    """Detects, describes and stereo-matches one frame."""
    features = orb.detect(frame.left, settings.orb)
    disparities = stereo.disparities(frame, camera, features.pixels, settings.stereo)
    points = camera.point_from_pixel(features.pixels, disparities[:, 0])
    return Keyframe(frame_index, frame, features, disparities, points, patch_align.half_pyramid(frame.left))


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """What a keyframe policy looks at: where the frame is by odometry, which points it tracks, and how the picture is."""

    stamp_ns: int
    odom_from_body: Array
    track_ids: NDArray[np.int64]
    scene_depth_m: float
    sharpness: float
    after_gap: bool


class KeyframePolicy:
    """Chooses by overlap with the last keyframe, by motion, or by count; never a blurred frame unless tracking would break."""

    def __init__(self, settings: KeyframeSettings) -> None:
        self._settings = settings
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
        if last is None or frame.after_gap or s.policy == "every":
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
    """Variance of the Laplacian at half size: falls with motion blur."""
    return float(cv2.Laplacian(stereo.halved(frame.left), cv2.CV_32F).var())
