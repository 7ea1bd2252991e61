"""Points followed through a recording: optical flow where frames are close, descriptors where they are not."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features import flow, orb, patch_align, stereo
from fleetmap.features.corners import spread_corners
from fleetmap.features.extraction import extract
from fleetmap.features.matching import match_mutual
from fleetmap.features.settings import AlignSettings, OrbSettings, StereoSettings
from fleetmap.geometry import Array, transform_points
from fleetmap.odometry.settings import TrackerSettings
from fleetmap.pnp.pnp import (
    GATE_SQUARED,
    REFINEMENT,
    Correspondences,
    PnpResult,
    pnp_with_rotation,
    ransac_pnp,
)
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera

_LEVELS_WHEN_SURE, _HELD_WHEN_SURE = 1, 0.6
_MARGIN_PX = 6.0  # of the image, where no point is followed to
Ids = NDArray[np.int64]
_FLOW_ITERATIONS = 200  # finds a motion that a third of the points share; with fewer the flow has failed
MotionSince = Callable[[int], Array | None]


@dataclass(frozen=True, slots=True)
class Earlier:
    """Observations of an earlier frame, for tracks that were begun there only now, and the motion since.

    ids (N,), pixels (N, 3) u_left v u_right, cam_from_earlier (4, 4).
    """

    frame_index: int
    ids: Ids
    pixels: Array
    cam_from_earlier: Array


@dataclass(frozen=True, slots=True)
class Tracked:
    """What one frame saw.

    ids (N,), ascending, and pixels (N, 3) u_left v u_right of the current frame. cam_from_previous: the motion measured since the
    previous frame, None where too few points agree; `pnp`: where that comes from, None after a gap. Then
    (by_descriptors) `earlier` holds what was matched, best first.
    """

    ids: Ids
    pixels: Array
    earlier: tuple[Earlier, ...]
    cam_from_previous: Array | None
    inlier_share: float
    by_descriptors: bool
    pnp: PnpResult | None = None

    @property
    def lost(self) -> bool:
        """Whether nothing ties this frame to any earlier one."""
        return self.cam_from_previous is None and not self.earlier


@dataclass(frozen=True, slots=True)
class _Remembered:
    frame_index: int
    pyramid: patch_align.Pyramid
    features: orb.Features
    disparities: Array
    points_cam: Array


class Followed(NamedTuple):
    """Where N points went: places (N, 2), which of them hold (N,), points_cam (N, 3) before, and how many of those with depth agree with
    the motion (4, 4), of that information (6, 6) and squared normalised residuals; -1 where they determine none."""

    places: Array
    kept: NDArray[np.bool_]
    points_cam: Array
    agree: int
    motion: Array
    information: Array
    squared: Array


@dataclass
class _Points:
    ids: Ids
    pixels: Array  # (N, 3)

    def take(self, keep: NDArray[np.bool_]) -> "_Points":
        return _Points(self.ids[keep], self.pixels[keep])


class Tracker:
    """Feeds on rectified frames in order; ids never repeat."""

    def __init__(
        self, camera: StereoCamera, settings: TrackerSettings, stereo_settings: StereoSettings | None = None
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._stereo = stereo_settings or StereoSettings()
        self._orb = OrbSettings(count=settings.match_features)
        self._previous: RectifiedFrame | None = None
        nothing = flow.Pyramid(np.zeros((0, 0), np.uint8))
        self._pyramids = [nothing, nothing]  # of the previous frame and of this one
        self._lens = camera.lens
        self._points = _Points(np.zeros(0, np.int64), np.zeros((0, 3)))
        self._next_id = 0
        self._frame_index = -1
        self._memory: list[_Remembered] = []

    def track(
        self, frame: RectifiedFrame, motion_since: MotionSince, rotation_sigma_rad: float | None = None
    ) -> Tracked:
        """Follows the points into `frame`.

        motion_since(frame_index) predicts cam_from_earlier (4, 4) since a frame counted from 0, None where it is
        forgotten; rotation_sigma_rad says how well its rotation is known, None where it is only a guess.
        """
        motion: Array | None = None
        pnp: PnpResult | None = None
        earlier: tuple[Earlier, ...] = ()
        share, far = 1.0, False
        self._frame_index += 1
        self._pyramids[1] = flow.Pyramid(frame.left)
        if self._previous is not None:
            far = (frame.stamp_ns - self._previous.stamp_ns) * 1e-9 > self._settings.max_gap_s
            if far:
                earlier, share = self._rematch(frame, motion_since, rotation_sigma_rad)
                motion = next((e.cam_from_earlier for e in earlier if e.frame_index == self._frame_index - 1), None)
            else:
                self._memory.clear()
                guess = motion_since(self._frame_index - 1)
                sure = guess is not None and rotation_sigma_rad is not None
                pnp, share = self._follow(frame, np.eye(4) if guess is None else guess, sure)
                if pnp is not None:
                    motion = pnp.cam_from_source
        self._renew_disparities(frame)
        self._add_corners(frame)
        self._previous = frame
        self._pyramids[0] = self._pyramids[1]
        return Tracked(self._points.ids.copy(), self._points.pixels.copy(), earlier, motion, share, far, pnp)

    def _follow(self, frame: RectifiedFrame, cam_from_previous: Array, sure: bool) -> tuple[PnpResult | None, float]:
        """sure: the motion is a prediction, not a guess.

        From a prediction one level above the image is enough: coarser levels cost as much again and mix near and far points.
        Where too few points hold, the prediction was wrong, and all levels are used.
        """
        if not len(self._points.ids):
            return None, 0.0
        guess, levels = np.ascontiguousarray(cam_from_previous), self._settings.pyramid_levels
        followed = self._followed(guess, min(levels, _LEVELS_WHEN_SURE) if sure else levels)
        if sure and followed.kept.mean() < _HELD_WHEN_SURE:
            followed = self._followed(guess, levels)
        pnp, kept = self._motion(followed), followed.kept
        before = int(kept.sum())
        if pnp is not None:  # the old disparity is the prior of the new one
            motion, limit_px = np.ascontiguousarray(pnp.cam_from_source), self._settings.ransac_px
            known = self._points.pixels, followed.points_cam, followed.places
            kept, carried = core.carry_points(*known, kept, motion, self._lens, limit_px)
        else:
            carried = np.column_stack([followed.places, np.full(len(kept), np.nan)])
        share = float(kept.sum()) / max(before, 1)
        self._points = _Points(self._points.ids[kept], carried[kept])
        return pnp, share

    def _followed(self, cam_from_previous: Array, levels: int) -> Followed:
        s, (before, now) = self._settings, (pyramid.down_to(levels) for pyramid in self._pyramids)
        limits = s.window_px // 2, s.back_check_px, _MARGIN_PX, s.min_inliers, REFINEMENT
        return Followed(*core.track_points(before, now, self._points.pixels, cam_from_previous, self._lens, *limits))

    def _motion(self, followed: Followed) -> PnpResult | None:
        """cam_from_previous from points with depth.

        Least squares from the guess, RANSAC where most points disagree with it.
        """
        points_cam, kept, squared = followed.points_cam, followed.kept, followed.squared
        count = len(squared)
        if count < self._settings.min_inliers:
            return None
        result = None
        if followed.agree >= 0:
            result = PnpResult(followed.motion, followed.information, squared < GATE_SQUARED, squared)
        if followed.agree > 0.6 * count:
            return result
        usable = kept & np.isfinite(points_cam).all(axis=1)
        measured = np.column_stack([followed.places[usable], np.full(count, np.nan)])
        matches = Correspondences(self._camera, points_cam[usable], measured, np.ones((count, 2)))
        again = ransac_pnp(
            matches,
            threshold_px=self._settings.ransac_px,
            min_inliers=self._settings.min_inliers,
            seed=count,
            iterations=_FLOW_ITERATIONS,
        )
        if again is None or (result is not None and result.inliers.sum() >= again.inliers.sum()):
            again = result
        return again if again is not None and again.inliers.sum() >= self._settings.min_inliers else None

    def _rematch(
        self, frame: RectifiedFrame, motion_since: MotionSince, rotation_sigma_rad: float | None
    ) -> tuple[tuple[Earlier, ...], float]:
        """After a gap: new tracks from descriptor matches with the last few frames.

        The matches with each frame are verified by one rigid motion.
        """
        assert self._previous is not None
        if not self._memory or self._memory[-1].frame_index != self._frame_index - 1:
            self._memory.append(self._remember(self._previous, self._frame_index - 1))
        current = self._remember(frame, self._frame_index)
        self._points = _Points(np.zeros(0, np.int64), np.zeros((0, 3)))
        found = []
        free = np.ones(len(current.features), bool)
        for old in reversed(self._memory):
            guess = motion_since(old.frame_index)
            matched = self._match_pair(
                old, current, free, np.eye(4) if guess is None else guess, None if guess is None else rotation_sigma_rad
            )
            if matched is not None:
                found.append(matched)
        self._memory = [*self._memory[-(self._settings.memory_frames - 1) :], current]
        share = sum(len(e.ids) for e in found) / max(len(current.features), 1)
        return tuple(sorted(found, key=lambda e: -len(e.ids))), share

    def _remember(self, frame: RectifiedFrame, frame_index: int) -> _Remembered:
        features = extract(frame.left, self._orb)
        depth = stereo.disparities(frame, self._camera, features.pixels, self._stereo)[:, 0]
        points = self._camera.point_from_pixel(features.pixels, depth)
        return _Remembered(frame_index, patch_align.half_pyramid(frame.left), features, depth, points)

    def _match_pair(
        self,
        old: _Remembered,
        current: _Remembered,
        free: NDArray[np.bool_],
        guess: Array,
        rotation_sigma_rad: float | None,
    ) -> Earlier | None:
        """Matches with one earlier frame; adds their tracks to the current points and takes them out of `free`."""
        usable = np.flatnonzero(free)
        known = np.flatnonzero(np.isfinite(old.disparities))
        pairs = match_mutual(old.features.descriptors[known], current.features.descriptors[usable], 70, 0.85)
        a, b = known[pairs[:, 0]], usable[pairs[:, 1]]
        measured = np.column_stack([current.features.pixels[b], current.features.pixels[b, 0] - current.disparities[b]])
        found = self._wide_motion(old.points_cam[a], measured, guess, rotation_sigma_rad)
        if found is None:
            return None
        a, b = a[found.inliers], b[found.inliers]
        before, now = old.features.take(a), current.features.take(b)
        warp = patch_align.similarity_from_features(before.octaves, before.angles_deg, now.octaves, now.angles_deg)
        reference = patch_align.Patches(old.pyramid, before.pixels, before.octaves)
        patches = patch_align.Patches(current.pyramid, now.pixels, now.octaves)
        refined = patch_align.refine_matches(reference, patches, warp, AlignSettings())
        sure = np.isfinite(refined[:, 0])
        a, b = a[sure], b[sure]
        if len(a) < self._settings.min_inliers_known_rotation:
            return None
        free[b] = False
        ids = np.arange(self._next_id, self._next_id + len(a))
        self._next_id += len(a)
        depth = transform_points(found.cam_from_source, old.points_cam[a])[:, 2]
        disparity = self._camera.focal_px * self._camera.baseline_m / depth
        fresh = np.column_stack([refined[sure, :2], refined[sure, 0] - disparity])
        self._points = _Points(np.concatenate([self._points.ids, ids]), np.concatenate([self._points.pixels, fresh]))
        earlier = np.column_stack([old.features.pixels[a], old.features.pixels[a, 0] - old.disparities[a]])
        return Earlier(old.frame_index, ids, earlier, found.cam_from_source)

    def _wide_motion(
        self, points_cam: Array, measured: Array, guess: Array, rotation_sigma_rad: float | None
    ) -> PnpResult | None:
        """cam_from_previous from raw descriptor matches: with a known rotation first, without any guess else."""
        settings, least = self._settings, self._settings.min_inliers
        matches = Correspondences(self._camera, points_cam, measured, np.full((len(points_cam), 2), 1.5))
        if rotation_sigma_rad is not None:
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

    def _renew_disparities(self, frame: RectifiedFrame) -> None:
        if not len(self._points.ids):
            return
        prior = self._points.pixels[:, 0] - self._points.pixels[:, 2]
        found = stereo.disparities(frame, self._camera, self._points.pixels[:, :2], self._stereo, prior)
        self._points.pixels[:, 2] = self._points.pixels[:, 0] - found[:, 0]

    def _add_corners(self, frame: RectifiedFrame) -> None:
        missing = self._settings.max_points - len(self._points.ids)
        if missing < 0.15 * self._settings.max_points:
            return
        corners = spread_corners(
            frame.left,
            missing,
            min_distance_px=self._settings.min_distance_px,
            taken=self._points.pixels[:, :2].astype(np.float32),
        ).astype(np.float64)
        found = stereo.disparities(frame, self._camera, corners, self._stereo)
        fresh = np.column_stack([corners, corners[:, 0] - found[:, 0]])
        ids = np.arange(self._next_id, self._next_id + len(corners))
        self._next_id += len(corners)
        self._points = _Points(np.concatenate([self._points.ids, ids]), np.concatenate([self._points.pixels, fresh]))
