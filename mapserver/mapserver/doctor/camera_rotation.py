"""Rotation of the camera between two frames, by the images alone."""

import cv2
import numpy as np

from fleetmap.geometry import AnyArray, Array, se3, se3_inverse, so3_exp
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera

_CORNERS, _MIN_POINTS = 250, 25
_LK_WINDOW, _LK_LEVELS = (15, 15), 4


def rotation_between(before: RectifiedFrame, after: RectifiedFrame, camera: StereoCamera) -> Array | None:
    """(3, 3) before_from_after in camera axes, None where too little can be tracked.

    With a second camera or depth by perspective-n-point from the first frame's points, which is exact in pure rotation
    too, else by the essential matrix.
    """
    corners = cv2.goodFeaturesToTrack(before.left, _CORNERS, 0.01, 12)
    if corners is None or len(corners) < _MIN_POINTS:
        return None
    pixels = corners.reshape(-1, 2).astype(np.float32)
    tracked, is_tracked = _track(before.left, after.left, pixels)
    disparities = _disparities(before, pixels)
    has_depth = is_tracked & (disparities > 0.5)
    if camera.baseline_m > 0 and has_depth.sum() >= _MIN_POINTS:
        points_cam = camera.point_from_pixel(pixels[has_depth].astype(np.float64), disparities[has_depth])
        return _rotation_of_points(points_cam, tracked[has_depth], camera)
    if is_tracked.sum() < _MIN_POINTS:
        return None
    return _rotation_of_rays(pixels[is_tracked], tracked[is_tracked], camera)


def _track(first: AnyArray, second: AnyArray, pixels: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Where the pixels (N, 2) went, and which of them came back to within half a pixel."""
    there, found, _ = _lucas_kanade(first, second, pixels)
    back, found_back, _ = _lucas_kanade(second, first, there)
    returned = np.abs(back - pixels).max(axis=1) < 0.5
    return there, returned & (found == 1) & (found_back == 1)


def _lucas_kanade(first: AnyArray, second: AnyArray, pixels: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
    found, status, error = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
        first, second, pixels.reshape(-1, 1, 2), None, winSize=_LK_WINDOW, maxLevel=_LK_LEVELS
    )
    return found.reshape(-1, 2), status.ravel(), error.ravel()


def _disparities(frame: RectifiedFrame, pixels: AnyArray) -> Array:
    """(N,) disparity of pixels; NaN where unknown."""
    disparities = np.full(len(pixels), np.nan)
    if frame.disparity_px is not None:
        columns, rows = np.round(pixels).astype(int).T
        return np.asarray(frame.disparity_px[rows, columns], np.float64)
    if frame.right is None:
        return disparities
    there, is_found = _track(frame.left, frame.right, pixels)
    is_found &= np.abs(there[:, 1] - pixels[:, 1]) < 2.0
    disparities[is_found] = (pixels - there)[is_found, 0]
    return disparities


def _rotation_of_points(points_cam: Array, pixels: AnyArray, camera: StereoCamera) -> Array | None:
    found, rotvec, shift, inliers = cv2.solvePnPRansac(
        points_cam, pixels.astype(np.float64), camera.matrix, None, iterationsCount=100, reprojectionError=1.5
    )
    if not found or inliers is None or len(inliers) < _MIN_POINTS:
        return None
    kept = inliers.ravel()
    rotvec, shift = cv2.solvePnPRefineLM(
        points_cam[kept], pixels[kept].astype(np.float64), camera.matrix, np.zeros(0), rotvec, shift
    )
    turn, move = np.asarray(rotvec, np.float64).ravel(), np.asarray(shift, np.float64).ravel()
    after_from_before = se3(so3_exp(turn), move)
    return np.asarray(se3_inverse(after_from_before)[:3, :3])


def _rotation_of_rays(before: AnyArray, after: AnyArray, camera: StereoCamera) -> Array | None:
    essential, inliers = cv2.findEssentialMat(before, after, camera.matrix, cv2.RANSAC, 0.999, 1.0)
    if essential is None or essential.shape != (3, 3) or int(inliers.sum()) < _MIN_POINTS:
        return None
    _, after_from_before, _, _ = cv2.recoverPose(essential, before, after, camera.matrix, mask=inliers)
    return np.asarray(after_from_before.T, np.float64)
