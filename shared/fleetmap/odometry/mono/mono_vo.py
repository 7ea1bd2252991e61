"""Visual odometry of one camera, up to scale: initialized from two keyframes, refined over a window of keyframes."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array, midpoints, se3, se3_inverse, transform_points
from fleetmap.odometry.mono.two_view import rays_from_pixels, two_view_motion
from fleetmap.odometry.settings import MonocularSettings
from fleetmap.pnp.pnp import Correspondences, ransac_pnp, refine_pnp
from fleetmap.sensors.rectification import StereoCamera

Ids = NDArray[np.int64]
_HUBER_SIGMAS = 2.5
_ITERATIONS = 8
# Points share the errors of their keyframes: a resection's own sigma is too small by about this factor.
_CORRELATION = 3.0
_LONGEST_WAIT = 60  # frames without a first pair before the search starts again from a later one


class Frame(NamedTuple):
    """One image: its observed ids (N,), their pixels (N, 2), and vision_from_cam (4, 4), a guess until it is located."""

    frame_index: int
    ids: Ids
    pixels: Array
    vision_from_cam: Array


@dataclass(frozen=True, slots=True)
class VisualEstimate:
    """Result of one frame: vision_from_cam, None before the first pair of keyframes and after lost tracking.

    cov_rot_trans (6, 6) in vision axes. revised: earlier frames that are located only now, (frame index, vision_from_cam).
    lost: this frame has no link to earlier ones, and `vision` restarts.
    """

    vision_from_cam: Array | None
    cov_rot_trans: Array
    revised: tuple[tuple[int, Array], ...] = ()
    lost: bool = False


@dataclass
class _LocalMap:
    """The window's keyframes and their points, by track id; for tracks without a point, their vision_from_cam and pixels."""

    keyframes: list[Frame] = field(default_factory=list)
    points: dict[int, Array] = field(default_factory=dict)
    first_seen: dict[int, tuple[Array, Array]] = field(default_factory=dict)


class VisualOdometry:
    """Processes the tracked points frame by frame; lengths are in units of the first scene's median depth."""

    def __init__(self, camera: StereoCamera, settings: MonocularSettings) -> None:
        self._camera, self._settings = camera, settings
        self._map = _LocalMap()
        self._waiting: list[Frame] = []
        self._last = np.eye(4)  # vision_from_cam of the frame before
        self.step = np.eye(4)  # previous camera from this one
        self._covariance = np.zeros((6, 6))
        self.depth = settings.first_depth  # of the points, the median along the optical axis

    @property
    def started(self) -> bool:
        """True if there are points to locate frames by."""
        return bool(self._map.keyframes)

    def points_in_camera(self, ids: Ids) -> Array:
        """(N, 3) points of these tracks in the last frame's camera, NaN where unknown."""
        known = np.array([self._map.points.get(i, _NOWHERE) for i in ids.tolist()]).reshape(-1, 3)
        return transform_points(se3_inverse(self._last), known)

    def add(self, frame_index: int, ids: Ids, pixels: Array) -> VisualEstimate:
        """Return the estimate at one frame from the ids (N,) and pixels (N, 2) of its tracks."""
        frame = Frame(frame_index, ids, pixels, self._last @ self.step)
        if not self.started:
            return self._first_frames(frame)
        located = self._locate(frame)
        if located is None:
            self._map, self._waiting, self.step = _LocalMap(), [frame], np.eye(4)
            return VisualEstimate(None, self._covariance, lost=True)
        frame, cov = located
        self._place_new(frame)
        if self._is_new(frame):
            self._map.keyframes.append(frame)
            self._adjust(held=2)
            self._map.keyframes = self._map.keyframes[-self._settings.window_views :]
            seen = {i for v in self._map.keyframes for i in v.ids.tolist()}
            self._map.points = {i: p for i, p in self._map.points.items() if i in seen}
            frame = self._map.keyframes[-1]
        return self._advance(frame, cov)

    def _advance(self, frame: Frame, cov: Array, revised: Iterable[Frame] = ()) -> VisualEstimate:
        vision_from_cam = frame.vision_from_cam
        self.step = se3_inverse(self._last) @ vision_from_cam
        length = float(np.linalg.norm(self.step[:3, 3]))
        rotation = np.kron(np.eye(2), vision_from_cam[:3, :3])
        grown = np.diag([1e-7] * 3 + [(self._settings.drift_share * length) ** 2 + 1e-9] * 3)
        self._covariance = self._covariance + grown + 0.1 * rotation @ (_CORRELATION**2 * cov) @ rotation.T
        self._last = vision_from_cam
        known = [self._map.points[i] for i in self._map.keyframes[-1].ids.tolist() if i in self._map.points]
        depths = transform_points(se3_inverse(vision_from_cam), np.array(known).reshape(-1, 3))[:, 2]
        if (depths > 0).any():
            self.depth = float(np.median(depths[depths > 0]))
        earlier = tuple((frame.frame_index, frame.vision_from_cam) for frame in revised)
        return VisualEstimate(vision_from_cam, self._covariance.copy(), earlier)

    # --- the first pair ---

    def _first_frames(self, frame: Frame) -> VisualEstimate:
        self._waiting.append(frame)
        nothing = VisualEstimate(None, self._covariance)
        while len(self._waiting) > 1:
            first = self._waiting[0]
            _, a, b = np.intersect1d(first.ids, frame.ids, return_indices=True)
            if len(a) < self._settings.first_min_points or len(self._waiting) > _LONGEST_WAIT:
                self._waiting.pop(0)  # too few tracks of the oldest frame are left: begin later
            elif (
                np.median(np.linalg.norm(first.pixels[a] - frame.pixels[b], axis=1)) < self._settings.first_parallax_px
            ):
                return nothing
            else:
                return self._begin(first.ids[a], first.pixels[a], frame.pixels[b]) or nothing
        return nothing

    def _begin(self, ids: Ids, before: Array, now: Array) -> VisualEstimate | None:
        s = self._settings
        found = two_view_motion(self._camera, before, now, seed=len(ids))
        if (
            found is None
            or found.inliers.sum() < max(s.first_min_points, 0.6 * len(ids))
            or found.parallax_rad < np.radians(s.min_angle_deg)
        ):
            return None
        unit = self.depth / float(np.median(found.points_a[found.inliers, 2]))
        now_from_first = se3(found.b_from_a[:3, :3], unit * found.b_from_a[:3, 3])
        points = transform_points(self._last, unit * found.points_a[found.inliers])
        first = self._waiting[0]._replace(vision_from_cam=self._last)
        last = self._waiting[-1]._replace(vision_from_cam=self._last @ se3_inverse(now_from_first))
        self._map = _LocalMap([first, last], dict(zip(ids[found.inliers].tolist(), points, strict=True)))
        self._adjust(held=1)
        placed = self._place_between()
        if placed is None or len(self._map.points) < s.first_min_points // 2:
            self._map = _LocalMap()
            return None
        placed = self._normalised(first.vision_from_cam, placed)
        self._waiting = []
        last = self._map.keyframes[-1]
        located = self._locate(last)
        self._last = placed[-2].vision_from_cam
        return self._advance(last, np.eye(6) * 1e-6 if located is None else located[1], placed[:-1])

    def _place_between(self) -> list[Frame] | None:
        """Locate all waiting frames by the points of the first and the last; None if one fails. Some become keyframes.

        Twice, with an adjustment between: two keyframes of a flat scene alone can leave the rotation between them off by many degrees.
        """
        between = self._located_between()
        if between is None:
            return None
        stride = max(1, -(-len(between) // (self._settings.window_views - 3)))
        self._map.keyframes[1:1] = between[stride // 2 :: stride]
        self._adjust(held=1)
        between = self._located_between()
        return None if between is None else [self._map.keyframes[0], *between, self._map.keyframes[-1]]

    def _located_between(self) -> list[Frame] | None:
        found = self._map.keyframes[:1]
        for waiting in self._waiting[1:-1]:
            located = self._locate(waiting._replace(vision_from_cam=found[-1].vision_from_cam))
            if located is None:
                return None
            found.append(located[0])
        return found[1:]

    def _normalised(self, vision_from_first: Array, placed: list[Frame]) -> list[Frame]:
        """Scale the new map so that the median depth of its points is the unit, and the placed frames with it."""
        points = transform_points(se3_inverse(vision_from_first), np.array(list(self._map.points.values())))
        unit, origin = self.depth / float(np.median(points[:, 2])), vision_from_first[:3, 3]

        def scaled(frame: Frame) -> Frame:
            vision_from_cam = frame.vision_from_cam.copy()
            vision_from_cam[:3, 3] = origin + unit * (vision_from_cam[:3, 3] - origin)
            return frame._replace(vision_from_cam=vision_from_cam)

        self._map.points = {i: origin + unit * (p - origin) for i, p in self._map.points.items()}
        self._map.keyframes = list(map(scaled, self._map.keyframes))
        return list(map(scaled, placed))

    # --- one frame, and the window ---

    def _locate(self, frame: Frame) -> tuple[Frame, Array] | None:
        """Return the frame as located by known points, and the covariance (6, 6, camera axes); None if too few agree."""
        s = self._settings
        rows = [n for n, i in enumerate(frame.ids.tolist()) if i in self._map.points]
        if len(rows) < s.min_points:
            return None
        points = np.array([self._map.points[i] for i in frame.ids[rows].tolist()])
        measured = np.column_stack([frame.pixels[rows], np.full(len(rows), np.nan)])
        matches = Correspondences(self._camera, points, measured, np.full((len(rows), 2), s.sigma_px))
        found = refine_pnp(matches, se3_inverse(frame.vision_from_cam))
        if found is None or found.inliers.sum() < max(s.min_points, 0.6 * len(rows)):
            again = ransac_pnp(matches, threshold_px=s.max_error_px, min_inliers=s.min_points, seed=len(rows))
            found = again if again is not None and again.inliers.sum() >= 0.4 * len(rows) else None
        return None if found is None else (_at(frame, se3_inverse(found.cam_from_source)), found.cov_rot_trans)

    def _is_new(self, frame: Frame) -> bool:
        s, last = self._settings, self._map.keyframes[-1]
        shared, a, b = np.intersect1d(last.ids, frame.ids, return_indices=True)
        if len(shared) < s.view_overlap * len(last.ids):
            return True
        known = sum(i in self._map.points for i in frame.ids.tolist())
        wanted_px = s.view_parallax_px * (0.4 if known < 0.5 * len(frame.ids) else 1.0)
        return bool(np.median(np.linalg.norm(last.pixels[a] - frame.pixels[b], axis=1)) > wanted_px)

    def _place_new(self, frame: Frame) -> None:
        """Triangulate every track whose parallax since its first observation is large enough."""
        points, first_seen = self._map.points, self._map.first_seen
        wanted = np.array([i not in points for i in frame.ids.tolist()], bool)
        for track_id, pixel in zip(frame.ids[wanted].tolist(), frame.pixels[wanted], strict=True):
            first_seen.setdefault(track_id, (frame.vision_from_cam, pixel))
        for gone in first_seen.keys() - set(frame.ids.tolist()):
            del first_seen[gone]
        if not wanted.any():
            return
        ids, now = frame.ids[wanted], frame.pixels[wanted]
        first = np.array([first_seen[i][0] for i in ids.tolist()])
        found = self._between(first, np.array([first_seen[i][1] for i in ids.tolist()]), frame.vision_from_cam, now)
        for track_id, point in zip(ids.tolist(), found, strict=True):
            if np.isfinite(point[0]):
                points[track_id] = point
                del first_seen[track_id]

    def _between(self, first: Array, before: Array, last: Array, now: Array) -> Array:
        """(N, 3) points midway between rays of cameras first (N, 4, 4) and last (4, 4); NaN where angle or pixels forbid it."""
        rays_a = np.einsum("nij,nj->ni", first[:, :3, :3], rays_from_pixels(self._camera, before))
        rays_b = rays_from_pixels(self._camera, now) @ last[:3, :3].T
        points, cosines = midpoints(rays_a, rays_b, last[:3, 3] - first[:, :3, 3])
        points += first[:, :3, 3]
        away = np.einsum("nji,nj->ni", first[:, :3, :3], points - first[:, :3, 3])
        off_a = np.linalg.norm(self._camera.pixel_from_point(away)[:, :2] - before, axis=1)
        off_b = np.linalg.norm(
            self._camera.pixel_from_point(transform_points(se3_inverse(last), points))[:, :2] - now, axis=1
        )
        wide = cosines < np.cos(np.radians(self._settings.point_angle_deg))
        limit = 0.5 * self._settings.max_error_px
        with np.errstate(invalid="ignore"):
            good = wide & (off_a < limit) & (off_b < limit)
        points[~good] = np.nan
        return np.asarray(points, np.float64)

    def _adjust(self, held: int) -> None:
        """Bundle adjustment of the window; its `held` oldest keyframes stay, points that do not fit go."""
        keyframes, points = self._map.keyframes, self._map.points
        rows = [{i: n for n, i in enumerate(v.ids.tolist())} for v in keyframes]
        numbers: list[int] = []
        starts, obs_views = [0], list[int]()
        pixels: list[Array] = []
        for track_id in sorted(points):
            seen = [k for k, row in enumerate(rows) if track_id in row]
            if len(seen) < 2:
                continue
            numbers.append(track_id)
            obs_views.extend(seen)
            pixels.extend(keyframes[k].pixels[rows[k][track_id]] for k in seen)
            starts.append(len(obs_views))
        if len(numbers) < self._settings.min_points or len(keyframes) <= held:
            return
        bounds, placed = np.array(starts, np.int64), np.array([v.vision_from_cam for v in keyframes])
        observed = bounds, np.array(obs_views, np.int64), np.array(pixels)
        limits = self._settings.sigma_px, _HUBER_SIGMAS, _ITERATIONS
        values = np.array([points[i] for i in numbers])
        placed, values, squared, _ = core.adjust_window(placed, held, values, *observed, self._camera.lens, *limits)
        worst = np.maximum.reduceat(squared, bounds[:-1])
        limit = (self._settings.max_error_px / self._settings.sigma_px) ** 2
        for track_id, value, off in zip(numbers, values, worst.tolist(), strict=True):
            if off < limit:
                points[track_id] = value
            else:
                del points[track_id]
        self._map.keyframes = [
            _at(frame, vision_from_cam) for frame, vision_from_cam in zip(keyframes, placed, strict=True)
        ]


_NOWHERE = np.full(3, np.nan)


def _at(frame: Frame, vision_from_cam: Array) -> Frame:
    """The frame at the nearest rigid transform: guesses are products of earlier results, whose rounding errors triple with every frame."""
    u, _, vt = np.linalg.svd(vision_from_cam[:3, :3])
    return frame._replace(vision_from_cam=se3(u @ vt, vision_from_cam[:3, 3]))
