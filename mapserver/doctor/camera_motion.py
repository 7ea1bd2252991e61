"""Motion of the camera between two frames, by the images alone."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from fleetmap import core
from fleetmap.features.settings import StereoSettings
from fleetmap.features.stereo import disparities
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import Stamps
from mapserver.doctor.sensors import SPARSE_S
from mapserver.survey.survey_inputs import TrackedFrame

_CORNERS, _MIN_POINTS = 250, 25
_WINDOW_PX, _LEVELS, _RETURNED_PX = 15, 4, 0.5
_STEREO = StereoSettings()
# Share of the covariance by the pixels' residuals. By the true poses of simulated drives a motion's is 2.8 times as large, for the
# points' depths have errors too, and half of it stays while a camera sees the same points.
_REPEATED = 1.4
SceneError = tuple[Array, float]
"""Covariance (6, 6), rotation vector and translation in camera axes, of what stays while the same points are seen; their median depth."""


@dataclass(frozen=True, slots=True)
class CameraTurns:
    """Motion from the images. Intervals from starts_ns to ends_ns (K,), rates_body_radps (K, 3) mean in body axes.

    ways_m (K, 3): position of the body at the end, in its axes at the start, at the calibration's scale; NaN with one camera.
    """

    starts_ns: Stamps
    ends_ns: Stamps
    rates_body_radps: Array
    ways_m: Array

    @classmethod
    def of(cls, motions: Iterable[tuple[int, int, Array | None]]) -> "CameraTurns":
        """Collect results of `body_motion`."""
        found = [each for each in motions if each[2] is not None]
        spans = np.array([[start_ns, end_ns] for start_ns, end_ns, _ in found], np.int64).reshape(-1, 2)
        moved = np.array([motion for *_, motion in found]).reshape(-1, 4, 4)
        rates = np.array([so3_log(motion[:3, :3]) for motion in moved]).reshape(-1, 3) / (np.diff(spans) * 1e-9)
        return cls(spans[:, 0], spans[:, 1], rates, moved[:, :3, 3])


class OdometryTurns:
    """The camera's motion as a survey's odometry sees it in the images, as far as they show it. repeats: images like the one before."""

    def __init__(self, body_from_cam: Array) -> None:
        self._body_from_cam = body_from_cam
        self._last: RectifiedFrame | None = None
        self.motions: list[tuple[int, int, Array | None]] = []
        self.repeats = 0

    def add(self, tracked: TrackedFrame) -> None:
        """Add the next frame."""
        before, self._last = self._last, tracked.frame
        if before is None or tracked.frame.stamp_ns - before.stamp_ns > SPARSE_S * 1e9:
            return
        self.repeats += np.array_equal(before.left, tracked.frame.left)
        seen, mount, motion = tracked.estimate.cam_from_previous, self._body_from_cam, None
        if seen is not None:
            motion = mount @ se3_inverse(seen) @ se3_inverse(mount)
        self.motions.append((before.stamp_ns, tracked.frame.stamp_ns, motion))


def body_motion(
    rig: tuple[StereoCamera, Array], pair: tuple[RectifiedFrame, RectifiedFrame]
) -> tuple[int, int, Array | None]:
    """Return stamps of two frames and the body's motion (4, 4) between them, earlier_from_later. rig: the camera, and body_from_cam."""
    (camera, body_from_cam), (before, after) = rig, pair
    motion, _ = motion_between(before, after, camera)
    if motion is None:
        return before.stamp_ns, after.stamp_ns, None
    axes, place = body_from_cam[:3, :3], body_from_cam[:3, 3]
    turn = axes @ motion[:3, :3] @ axes.T  # known even if the translation is not
    return before.stamp_ns, after.stamp_ns, se3(turn, axes @ motion[:3, 3] + place - turn @ place)


def motion_between(
    before: RectifiedFrame, after: RectifiedFrame, camera: StereoCamera
) -> tuple[Array | None, SceneError | None]:
    """Return (4, 4) before_from_after in camera axes, None with too few tracked points, and its error, None without depth.

    With a second camera or depth by perspective-n-point from the first frame's points, which is exact in pure rotation
    too, else the rotation of the essential matrix, and a translation of NaN.
    """
    is_clear = None if camera.clearance_px is None else (camera.clearance_px > _WINDOW_PX // 2).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(before.left, _CORNERS, 0.01, 12, mask=is_clear)
    if corners is None or len(corners) < _MIN_POINTS:
        return None, None
    pixels = corners.reshape(-1, 2).astype(np.float64)
    limits = _WINDOW_PX // 2, _LEVELS, _RETURNED_PX, -np.inf
    places, is_tracked = core.follow_pixels(before.left, after.left, pixels, pixels, *limits)
    found = disparities(before, camera, pixels, _STEREO)[:, 0]
    has_depth = is_tracked & np.isfinite(found)
    if camera.baseline_m > 0 and has_depth.sum() >= _MIN_POINTS:
        points_cam = camera.point_from_pixel(pixels[has_depth], found[has_depth])
        return _motion_of_points(points_cam, places[has_depth], camera)
    if is_tracked.sum() < _MIN_POINTS:
        return None, None
    return _turn_of_rays(pixels[is_tracked], places[is_tracked], camera), None


def _motion_of_points(points_cam: Array, pixels: Array, camera: StereoCamera) -> tuple[Array | None, SceneError | None]:
    found, rotvec, shift, inliers = cv2.solvePnPRansac(
        points_cam, pixels, camera.matrix, None, iterationsCount=100, reprojectionError=1.5
    )
    if not found or inliers is None or len(inliers) < _MIN_POINTS:
        return None, None
    kept = inliers.ravel()
    rotvec, shift = cv2.solvePnPRefineLM(points_cam[kept], pixels[kept], camera.matrix, np.zeros(0), rotvec, shift)
    turn, move = np.asarray(rotvec, np.float64).ravel(), np.asarray(shift, np.float64).ravel()
    if not (np.isfinite(turn).all() and np.isfinite(move).all()):
        return None, None
    seen, rows = cv2.projectPoints(points_cam[kept], turn, move, camera.matrix, None)
    variance_px2 = _REPEATED * float(np.mean((seen[:, 0] - pixels[kept]) ** 2))
    cov = np.linalg.pinv(rows[:, :6].T @ rows[:, :6]) * variance_px2
    return se3_inverse(se3(so3_exp(turn), move)), (cov, float(np.median(points_cam[kept, 2])))


def _turn_of_rays(before: Array, after: Array, camera: StereoCamera) -> Array | None:
    essential, inliers = cv2.findEssentialMat(before, after, camera.matrix, cv2.RANSAC, 0.999, 1.0)
    if essential is None or essential.shape != (3, 3) or int(inliers.sum()) < _MIN_POINTS:
        return None
    # Its two rotations differ by half a turn about the baseline. Points in front of both cameras do not decide between them if the
    # camera hardly moves; between consecutive frames it does not turn round.
    first, second, _ = cv2.decomposeEssentialMat(essential)
    after_from_before = first if np.trace(first) > np.trace(second) else second
    return se3(np.asarray(after_from_before.T, np.float64), np.full(3, np.nan))
