"""Point tracking: optical flow between close frames, descriptors after gaps."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features import orb, stereo
from fleetmap.features.extraction import extract
from fleetmap.features.matching import match_mutual
from fleetmap.features.patch_align import Patches, Pyramid, half_pyramid, refine_matches
from fleetmap.features.settings import AlignSettings, OrbSettings, StereoSettings
from fleetmap.geometry import Array, Mask, transform_points
from fleetmap.odometry.settings import TrackerSettings
from fleetmap.pnp.pnp import REFINEMENT, Correspondences, PnpResult, pnp_with_rotation, ransac_pnp
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera

Ids = NDArray[np.int64]
MotionSince = Callable[[int], Array | None]
# Of the points, that the flow must hold from a mere guess: below it descriptors say where to look, and the better result of both counts.
_HELD_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class Earlier:
    """Observations of an earlier frame for tracks that start there in hindsight, and the motion since.

    ids (N,), pixels (N, 3) u_left v u_right, cam_from_earlier (4, 4).
    """

    frame_index: int
    ids: Ids
    pixels: Array
    cam_from_earlier: Array


@dataclass(frozen=True, slots=True)
class Tracked:
    """Tracks of one frame.

    ids (N,), ascending, and pixels (N, 3) u_left v u_right of the current frame. cam_from_previous: the motion measured since the
    previous frame, None if too few points agree; `information` (6, 6) of a left perturbation of it, None after a gap. Then
    (by_descriptors) `earlier` holds the matches, best first.
    """

    ids: Ids
    pixels: Array
    earlier: tuple[Earlier, ...]
    cam_from_previous: Array | None
    inlier_share: float
    by_descriptors: bool
    information: Array | None = None

    def begun_in(self, frame_index: int, before: "Tracked") -> "Tracked":
        """Return the tracks of the second frame of a camera that was not followed before, with their observations in the first."""
        if self.cam_from_previous is None:
            return self
        kept = np.isin(before.ids, self.ids)
        return replace(
            self, earlier=(Earlier(frame_index, before.ids[kept], before.pixels[kept], self.cam_from_previous),)
        )

    @property
    def lost(self) -> bool:
        """True if this frame has no link to any earlier one."""
        return self.cam_from_previous is None and not self.earlier


@dataclass(frozen=True, slots=True)
class _Remembered:
    frame_index: int
    pyramid: Pyramid
    features: orb.Features
    disparities: Array
    points_cam: Array


class Tracker:
    """Tracks points through rectified frames in order; ids never repeat. `core.Tracker` handles close frames."""

    def __init__(
        self,
        camera: StereoCamera,
        settings: TrackerSettings,
        stereo_settings: StereoSettings | None = None,
        *,
        first_frame: int = 0,
        first_id: int = 0,
        points_in_camera: Callable[[Ids], Array] | None = None,
    ) -> None:
        """first_frame: number of the frame that comes first; first_id: of its first point. points_in_camera: for lack of a second camera,
        the points (N, 3) of tracks in the camera of the frame before, as known from several frames, NaN where unknown."""
        self._camera, self._settings, self._points_in_camera = camera, settings, points_in_camera
        self._stereo = stereo_settings or StereoSettings()
        self._orb = OrbSettings(count=settings.match_features)
        most_px = stereo.max_disparity_px(camera, self._stereo)
        self._points = core.Tracker(camera.lens, settings, self._stereo, most_px, REFINEMENT, first_id)
        self._previous: RectifiedFrame | None = None
        self._frame_index = first_frame - 1
        self._memory: list[_Remembered] = []

    def track(
        self, frame: RectifiedFrame, motion_since: MotionSince, rotation_sigma_rad: float | None = None
    ) -> Tracked:
        """Track the points into `frame`.

        motion_since(frame_index) predicts cam_from_earlier (4, 4) since a frame counted from 0, None if it is
        forgotten; rotation_sigma_rad: uncertainty of its rotation, None if it is only a guess.
        """
        self._frame_index += 1
        previous, self._previous = self._previous, frame
        if previous is None:
            self._points.begin(frame.left)
            self._step(frame)
            return Tracked(self._points.ids, self._points.pixels, (), None, 1.0, by_descriptors=False)
        if (frame.stamp_ns - previous.stamp_ns) * 1e-9 > self._settings.max_gap_s:
            self._points.begin(frame.left)
            earlier, share = self._rematch(previous, frame, motion_since, rotation_sigma_rad)
            motion = next((e.cam_from_earlier for e in earlier if e.frame_index == self._frame_index - 1), None)
            self._step(frame)
            return Tracked(self._points.ids, self._points.pixels, earlier, motion, share, by_descriptors=True)
        guess = motion_since(self._frame_index - 1)
        is_predicted = guess is not None and rotation_sigma_rad is not None
        guess, before, points_cam = np.eye(4) if guess is None else guess, self._points.ids, None
        if self._points_in_camera is not None:
            points_cam = self._points_in_camera(before)
            points_cam[~(points_cam[:, 2] > 0.0)] = np.nan
        solved, share = self._step(frame, guess, is_predicted, points_cam)
        held = np.isin(before, self._points.ids).sum()
        if is_predicted or not self._camera.baseline_m or (solved and held >= _HELD_SHARE * len(before)):
            self._memory.clear()
        elif (seen := self._described_motion(previous, frame)) is not None:
            # The points left the flow's reach: the guess was wrong. Those that it found instead may agree on a slide along edges.
            retried = self._step(frame, seen, again=True)
            if retried[0] is None or (solved and np.isin(before, self._points.ids).sum() <= held):
                retried = self._step(frame, guess, again=True)
            solved, share = retried
        motion, information = solved or (None, None)
        ids, pixels = self._points.ids, self._points.pixels
        if motion is None and points_cam is not None:
            # Without parallax none of the tracked points can be triangulated: they suffice to continue.
            motion = guess if np.isin(ids, before).sum() >= self._settings.min_inliers else None
        return Tracked(ids, pixels, (), motion, share, by_descriptors=False, information=information)

    @property
    def next_id(self) -> int:
        """Number of the next new point."""
        return self._points.add(np.zeros((0, 3)))

    def _step(
        self,
        frame: RectifiedFrame,
        cam_from_previous: Array | None = None,
        is_predicted: bool = False,
        points_cam: Array | None = None,
        again: bool = False,
    ) -> tuple[tuple[Array, Array] | None, float]:
        pair = None if frame.right is None else (frame.right, frame.half_left, frame.half_right)
        guess = None if cam_from_previous is None else np.ascontiguousarray(cam_from_previous)
        images = frame.left, pair, frame.disparity_px
        return self._points.track(*images, guess, is_predicted, points_cam, self._camera.clearance_px, again)

    def _described_motion(self, previous: RectifiedFrame, frame: RectifiedFrame) -> Array | None:
        """Return cam_from_previous (4, 4) by descriptors, None if too few agree."""
        earlier, current = self._remembered(previous, frame)
        every = np.arange(len(current.features))
        found = self._matched(earlier[-1], current, every, None, None)[2]
        return None if found is None else found.cam_from_source

    def _rematch(
        self,
        previous: RectifiedFrame,
        frame: RectifiedFrame,
        motion_since: MotionSince,
        rotation_sigma_rad: float | None,
    ) -> tuple[tuple[Earlier, ...], float]:
        """Start new tracks after a gap, from descriptor matches with the last few frames.

        The matches with each frame are verified by one rigid motion.
        """
        remembered, current = self._remembered(previous, frame)
        found = []
        free = np.ones(len(current.features), bool)
        for old in reversed(remembered):
            matched = self._match_pair(old, current, free, motion_since(old.frame_index), rotation_sigma_rad)
            if matched is not None:
                found.append(matched)
        share = sum(len(e.ids) for e in found) / max(len(current.features), 1)
        return tuple(sorted(found, key=lambda e: -len(e.ids))), share

    def _remembered(self, previous: RectifiedFrame, frame: RectifiedFrame) -> tuple[list[_Remembered], _Remembered]:
        """Return the last few frames that were not followed, with the one before them, and the current frame."""
        earlier = self._memory or [self._remember(previous, self._frame_index - 1)]
        current = self._remember(frame, self._frame_index)
        self._memory = [*earlier[-(self._settings.memory_frames - 1) :], current]
        return earlier, current

    def _remember(self, frame: RectifiedFrame, frame_index: int) -> _Remembered:
        features = extract(frame.left, self._orb, self._camera.clearance_px)
        depth = stereo.disparities(frame, self._camera, features.pixels, self._stereo)[:, 0]
        points = self._camera.point_from_pixel(features.pixels, depth)
        return _Remembered(frame_index, half_pyramid(frame.left), features, depth, points)

    def _match_pair(
        self, old: _Remembered, current: _Remembered, free: Mask, guess: Array | None, rotation_sigma_rad: float | None
    ) -> Earlier | None:
        """Match with one earlier frame; adds the tracks to the current points and removes them from `free`."""
        a, b, found = self._matched(old, current, np.flatnonzero(free), guess, rotation_sigma_rad)
        if found is None:
            return None
        a, b = a[found.inliers], b[found.inliers]
        before, now = (Patches.of(of.pyramid, of.features, chosen) for of, chosen in ((old, a), (current, b)))
        refined = refine_matches(before, now, AlignSettings())
        sure = np.isfinite(refined[:, 0])
        a, b = a[sure], b[sure]
        if len(a) < self._settings.min_inliers_known_rotation:
            return None
        free[b] = False
        depth = transform_points(found.cam_from_source, old.points_cam[a])[:, 2]
        disparity = self._camera.focal_px * self._camera.baseline_m / depth
        fresh = np.column_stack([refined[sure, :2], refined[sure, 0] - disparity])
        ids = self._points.add(fresh) + np.arange(len(fresh))
        earlier = np.column_stack([old.features.pixels[a], old.features.pixels[a, 0] - old.disparities[a]])
        return Earlier(old.frame_index, ids, earlier, found.cam_from_source)

    def _matched(
        self, old: _Remembered, current: _Remembered, usable: Ids, guess: Array | None, rotation_sigma_rad: float | None
    ) -> tuple[Ids, Ids, PnpResult | None]:
        """Return matches of old features (M,) with usable current ones (M,), and the motion that explains them."""
        known = np.flatnonzero(np.isfinite(old.disparities))
        pairs = match_mutual(old.features.descriptors[known], current.features.descriptors[usable], 70, 0.85)
        a, b = known[pairs[:, 0]], usable[pairs[:, 1]]
        measured = np.column_stack([current.features.pixels[b], current.features.pixels[b, 0] - current.disparities[b]])
        return a, b, self._wide_motion(old.points_cam[a], measured, guess, rotation_sigma_rad)

    def _wide_motion(
        self, points_cam: Array, measured: Array, guess: Array | None, rotation_sigma_rad: float | None
    ) -> PnpResult | None:
        """cam_from_previous from raw descriptor matches: first with the rotation of a guess that is known so well, then without."""
        settings, least = self._settings, self._settings.min_inliers
        matches = Correspondences(self._camera, points_cam, measured, np.full((len(points_cam), 2), 1.5))
        if guess is not None and rotation_sigma_rad is not None:
            found = pnp_with_rotation(
                matches,
                guess[:3, :3],
                threshold_px=4 * settings.ransac_px,
                min_inliers=settings.min_inliers_known_rotation,
                rotation_sigma_rad=rotation_sigma_rad,
            )
            if found is not None:
                return found
        found = ransac_pnp(matches, threshold_px=2 * settings.ransac_px, min_inliers=least, seed=len(measured))
        if found is None or found.inliers.sum() < max(least, 0.25 * len(points_cam)):
            return None
        return found
