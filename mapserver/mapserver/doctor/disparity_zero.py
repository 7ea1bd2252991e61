"""Stereo against motion: whether the depths of a pair of cameras explain the motion of the picture.

A right camera that is turned a little towards the left one, unlike its calibration, keeps its rows and adds the same to every
disparity: nothing in a single pair tells, and every depth is wrong. Motion tells: points move by their true inverse depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from fleetmap.geometry import AnyArray, Array, so3_exp
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from mapserver.doctor.camera_rotation import followed
from mapserver.doctor.findings import Finding, Limits, judge, not_judged

_NAME = "stereo against motion"
_MIN_POINTS, _MIN_PAIRS = 40, 5
_DRIVE = "drive past things that are near and far, for metres and not on the spot"
_MIN_FLOW_PX, _MIN_SPREAD_PX = 3.0, 2.0  # of the points' motion, and of their disparities
_LARGEST_SIGMA_PX = 1.0
_NOISE_PX = 0.5


@dataclass(frozen=True, slots=True)
class DisparityZero:
    """What must be added to disparities at the right image's middle for two moments to fit one rigid motion, and its sigma."""

    offset_px: float
    sigma_px: float


def disparity_zero(before: RectifiedFrame, after: RectifiedFrame, camera: StereoCamera) -> DisparityZero | None:
    """The offset by which two moments agree best; None where too little moved or too few points were followed.

    Unknown are rotation, translation and the offset: a point at ray r (z = 1) with disparity d is seen along R r + (d + offset (1 + x^2)) t
    / (focal baseline) afterwards, x along its ray in the right camera. Robust least squares, two rows for each point.
    """
    pixels, tracked, disparities = followed(before, after)
    if len(pixels) < _MIN_POINTS or np.median(np.hypot(*(tracked - pixels).T)) < _MIN_FLOW_PX:
        return None
    if np.subtract(*np.percentile(disparities, [90, 10])) < _MIN_SPREAD_PX:
        return None
    rays = np.column_stack([(pixels - [camera.cx_px, camera.cy_px]) / camera.focal_px, np.ones(len(pixels))])
    spread = 1.0 + (rays[:, 0] - disparities / camera.focal_px) ** 2  # a turned camera moves the picture's edges most

    def residuals(unknowns: Array) -> Array:
        moved = rays @ so3_exp(unknowns[:3]).T + (disparities + unknowns[6] * spread)[:, None] * unknowns[3:6] / 100.0
        seen = camera.focal_px * moved[:, :2] / np.maximum(moved[:, 2:], 1e-3) + [camera.cx_px, camera.cy_px]
        return np.asarray((seen - tracked).ravel() / _NOISE_PX)

    start = _start(rays, tracked, disparities, camera)
    if start is None:
        return None
    found = least_squares(residuals, start, loss="soft_l1", max_nfev=60)
    if not found.success or np.median(np.abs(found.fun)) > 4.0:
        return None
    jacobian = np.asarray(found.jac, np.float64)
    information = jacobian.T @ jacobian
    if np.linalg.cond(information) > 1e14:
        return None
    sigma = float(np.sqrt(np.linalg.inv(information)[6, 6]) * max(1.0, 1.4826 * float(np.median(np.abs(found.fun)))))
    return DisparityZero(float(found.x[6]), sigma)


def stereo_against_motion(zeros: Sequence[DisparityZero], camera: StereoCamera) -> Finding:
    """Judges the median of what the pairs say, in degrees by which the cameras' angle to each other is off."""
    good = [zero for zero in zeros if zero.sigma_px < _LARGEST_SIGMA_PX]
    if len(good) < _MIN_PAIRS:
        return not_judged(_NAME, f"{len(good)} pairs of moments say enough, {_MIN_PAIRS} are needed", _DRIVE)
    offsets = np.array([zero.offset_px for zero in good])
    offset_px = float(np.median(offsets))
    spread_px = float(1.4826 * np.median(np.abs(offsets - offset_px)) / np.sqrt(len(offsets)))
    angle_deg = float(np.degrees(np.arctan2(offset_px, camera.focal_px)))
    sure_deg = float(np.degrees(np.arctan2(max(abs(offset_px) - 3.0 * spread_px, 0.0), camera.focal_px)))
    words = f"disparities are {offset_px:+.2f} px from what motion says: the cameras' angle is off by {angle_deg:+.2f} degrees"
    advice = "calibrate the cameras again, or name the matching calibration with --calibration FILE"
    bad = f"{words}, and with it every depth; {advice}"
    return judge(_NAME, sure_deg, Limits(0.15, 0.4, "degrees for sure"), words, bad)


def _start(rays: Array, tracked: AnyArray, disparities: Array, camera: StereoCamera) -> Array | None:
    """Rotation by points taken to be at their disparity's depth, wherever that is positive."""
    usable = disparities > 0.5
    if usable.sum() < _MIN_POINTS // 2:
        usable, disparities = np.ones(len(rays), bool), disparities - disparities.min() + 1.0
    points = rays[usable] * (100.0 / disparities[usable])[:, None]
    found, turn, shift, _ = cv2.solvePnPRansac(
        points, tracked[usable].astype(np.float64), camera.matrix, None, iterationsCount=100, reprojectionError=3.0
    )
    if not found:
        return None
    return np.concatenate([np.ravel(turn), np.ravel(shift), [0.0]]).astype(np.float64)
