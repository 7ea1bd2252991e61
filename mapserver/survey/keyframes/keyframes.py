"""Keyframe selection, and the data of each keyframe."""

from collections import deque
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice

import cv2
import numpy as np

from fleetmap.features import orb, patch_align, stereo
from fleetmap.features.extraction import extract
from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from mapserver.survey.rig import frame_of_camera
from mapserver.survey.settings import KeyframeSettings, SurveySettings
from mapserver.survey.state import ImageStore, Keyframe, Pictures
from mapserver.survey.survey_inputs import SurveyTools

_BATCH = 2  # frames for one call: 0.05 s each


def make_keyframe(frame: RectifiedFrame, frame_index: int, camera: StereoCamera, settings: SurveySettings) -> Keyframe:
    """Detect, describe and stereo-match one frame; its pictures stay in memory."""
    return next(make_keyframes([(frame_index, frame)], [(0, camera)], settings, SurveyTools()))


def make_keyframes(
    frames: Iterable[tuple[int, RectifiedFrame]],
    cameras: Sequence[tuple[int, StereoCamera]],
    settings: SurveySettings,
    tools: SurveyTools,
) -> Iterator[Keyframe]:
    """Return keyframes of numbered frames; the executor extracts features while the next frames are awaited.

    cameras: see `rig.used_cameras`.
    """
    kept = tools.images
    waiting: deque[tuple[int, list[RectifiedFrame | None]]] = deque()
    models, black = [camera for _, camera in cameras], list[int]()
    first, scales = models[0], [_disparity_scale(models[0], camera) for camera in models]

    def batches() -> Iterator[list[list[RectifiedFrame | None]]]:
        source = iter(frames)
        while batch := list(islice(source, _BATCH)):
            seen = [[frame_of_camera(frame, camera) for camera, _ in cameras] for _, frame in batch]
            waiting.extend(zip((number for number, _ in batch), seen, strict=True))
            yield seen

    def stored(frame: RectifiedFrame | None) -> int:
        """Return the number of its pictures; one for all cameras without images."""
        if frame is None and black:
            return black[0]
        left = np.zeros((first.height_px, first.width_px), np.uint8) if frame is None else frame.left
        pictured = RectifiedFrame(0, left, left, None) if frame is None else replace(frame, others=())
        number = kept.put(Pictures(pictured, patch_align.half_pyramid(left)))
        black.extend([number] if frame is None else [])
        return number

    for found in tools.executor.map(_extract, (models, settings), batches()):
        for each in found:
            number, seen = waiting.popleft()
            assert seen[0] is not None
            about, keyframes = (number, seen[0].stamp_ns), []
            for frame, (features, disparities), scale in zip(seen, each, scales, strict=True):
                points = first.point_from_pixel(features.pixels, disparities[:, 0])
                own = Keyframe(*about, features, disparities, points, kept, stored(frame), disparity_scale=scale)
                keyframes.append(set_aside(own, kept))
            yield replace(keyframes[0], others=tuple(keyframes[1:]))


def _disparity_scale(first: StereoCamera, camera: StereoCamera) -> float:
    """Return the ratio of disparities of the first camera to those of another one with its pinhole."""
    return first.baseline_m / camera.baseline_m if camera.baseline_m > 0 else 1.0


def _extract(
    shared: tuple[list[StereoCamera], SurveySettings], frames: list[list[RectifiedFrame | None]]
) -> list[list[tuple[orb.Features, Array]]]:
    """Return features and disparities of each camera in some frames; disparities are those of the first camera's baseline."""
    cameras, settings = shared
    return [[_features_of(*each, cameras[0], settings) for each in zip(seen, cameras, strict=True)] for seen in frames]


def _features_of(
    frame: RectifiedFrame | None, camera: StereoCamera, first: StereoCamera, settings: SurveySettings
) -> tuple[orb.Features, Array]:
    if frame is None:
        return orb.Features.empty(), np.zeros((0, 2))
    features = extract(frame.left, settings.orb, camera.clearance_px)
    disparities = stereo.disparities(frame, camera, features.pixels, settings.stereo)
    return features, disparities * _disparity_scale(first, camera)


def set_aside(keyframe: Keyframe, store: ImageStore) -> Keyframe:
    """Return the same keyframe with its features in `store`."""
    own = keyframe.features
    found = own.pixels, own.octaves, own.angles_deg, own.descriptors, keyframe.disparities, keyframe.points_cam
    *features, disparities, points_cam = store.keep(found)
    return replace(keyframe, features=orb.Features(*features), disparities=disparities, points_cam=points_cam)


class KeyframePolicy:
    """Chooses by overlap with the last keyframe, by motion, or by count; never a blurred frame unless tracking would break."""

    def __init__(self, settings: KeyframeSettings, required: Container[int] = ()) -> None:
        """required: numbers of frames, counted from 0, that are always chosen."""
        self._settings, self._required = settings, required
        self._last: tuple[OdometryEstimate, Array] | None = None
        self._sharpness: deque[float] = deque(maxlen=31)
        self._count = -1

    def wants(self, estimate: OdometryEstimate, frame_from_body: Array, sharpness: float) -> bool:
        """True if this frame becomes a keyframe; frames must come in order. frame_from_body (4, 4): in one frame for all."""
        self._count += 1
        self._sharpness.append(sharpness)
        chosen = self._chooses(estimate, frame_from_body)
        if chosen:
            self._last = estimate, frame_from_body
        return chosen

    def _chooses(self, estimate: OdometryEstimate, frame_from_body: Array) -> bool:
        s = self._settings
        if self._last is None or estimate.after_gap or self._count in self._required or s.policy == "every":
            return True
        if s.policy == "every-nth":
            return self._count % s.every_nth == 0
        last, frame_from_last = self._last
        overlap = len(np.intersect1d(estimate.track_ids, last.track_ids)) / max(len(last.track_ids), 1)
        if overlap < s.break_overlap:
            return True
        if self._sharpness[-1] < s.min_sharpness * float(np.median(self._sharpness)):
            return False
        moved = se3_inverse(frame_from_last) @ frame_from_body
        return bool(
            overlap < s.min_overlap
            or np.degrees(rotation_angle_rad(moved[:3, :3])) > s.max_rotation_deg
            or np.linalg.norm(moved[:3, 3]) > s.max_parallax * estimate.scene_depth_m
            or (estimate.stamp_ns - last.stamp_ns) * 1e-9 > s.max_interval_s
        )


def sharpness(frame: RectifiedFrame) -> float:
    """Return the variance of the Laplacian at half size: it falls with motion blur. Source: Pech-Pacheco et al. 2000."""
    return float(cv2.Laplacian(frame.half_left, cv2.CV_32F).var())
